"""Tables as papers set them."""

import pytest

from lidarlearn.evaluation.score import Score
from lidarlearn.evaluation.table_layout import TableLayout

COLUMNS = {"seen": ["a", "b"], "new": ["c"]}


def row(method, sequence, error, failures=0):
    return Score(method, sequence, 300, 299.0, 5, error, 0.1, registration_failures=failures)


SCORES = [
    row("posenet_icp+p_f2m", "a", 1.0, 2),
    row("posenet_icp+p_f2m", "b", 3.0, 5),
    row("posenet_icp+p_f2m", "c", 9.0, 1),
    row("cv+p_f2m", "a", 0.5),
]


def cells(table):
    return {row[0]: row[1:] for row in (*table.rows, *table.reference)}


def test_a_cell_says_how_many_sequences_its_mean_is_over():
    short = [Score("m", name, 51, 60.0, 0) for name in ("b", "c")]
    table = TableLayout("t", {"all": ["a", "b", "c"]}).table([row("m", "a", 1.0), *short])
    assert cells(table) == {"m": ("1.000 (1 of 3)",)}
    assert any(note.startswith("(n of m)") for note in table.notes)


def test_a_sequence_that_is_there_twice_is_one_of_its_column():
    table = TableLayout("t", {"all": ["a", "b"]}).table([row("m", "a", 1.0), row("m", "a", 2.0)])
    assert cells(table) == {"m": ("1.500 (1 of 2)",)}


def test_a_cell_is_the_mean_over_its_column_and_says_what_was_seen_in_training_or_is_missing():
    layout = TableLayout("t", COLUMNS, published={"cv+p_f2m": [0.7, None]}, source="Somebody 2020")
    table = layout.table(SCORES, {("posenet_icp+p_f2m", name) for name in "abx"})
    assert cells(table) == {
        "posenet_icp+p_f2m": ("2.000*", "9.000"),
        "cv+p_f2m": ("0.500 (1 of 2)", "-"),
        "cv+p_f2m (Somebody 2020)": ("0.7", "-"),
    }
    notes = " ".join(table.notes)
    assert "seen: a, b." in notes and "trained on these" in notes and "only so many" in notes


def test_failures_are_added_up():
    table = TableLayout("t", COLUMNS, "registration_failures").table(SCORES)
    assert cells(table)["posenet_icp+p_f2m"] == ("7", "1")
    assert any("the sum over" in note for note in table.notes)


def test_a_network_that_saw_only_some_of_a_column_is_not_marked():
    table = TableLayout("t", COLUMNS).table(SCORES, {("posenet_icp+p_f2m", "a")})
    assert cells(table)["posenet_icp+p_f2m"] == ("2.000", "9.000")


def test_what_cannot_be_shown_is_refused():
    with pytest.raises(ValueError, match=r"table\.figure=ate"):
        TableLayout("t", COLUMNS, "ate")
    with pytest.raises(ValueError, match=r"published\.m: 1 values for 2 columns"):
        TableLayout("t", COLUMNS, published={"m": [1.0]})
