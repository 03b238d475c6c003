"""Tables with columns over several sequences, as in papers."""

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


def test_cell_shows_number_of_averaged_sequences():
    short = [Score("m", name, 51, 60.0, 0) for name in ("b", "c")]
    table = TableLayout("t", {"all": ["a", "b", "c"]}).table([row("m", "a", 1.0), *short])
    assert cells(table) == {"m": ("1.000 (1 of 3)",)}
    assert any(note.startswith("(n of m)") for note in table.notes)


def test_repeated_sequence_counts_once():
    table = TableLayout("t", {"all": ["a", "b"]}).table([row("m", "a", 1.0), row("m", "a", 2.0)])
    assert cells(table) == {"m": ("1.500 (1 of 2)",)}


def test_cells_mark_training_sequences_and_missing_results():
    layout = TableLayout("t", COLUMNS, published={"cv+p_f2m": [0.7, None]}, source="Somebody 2020")
    table = layout.table(SCORES, {("posenet_icp+p_f2m", name) for name in "abx"})
    assert cells(table) == {
        "posenet_icp+p_f2m": ("2.000*", "9.000"),
        "cv+p_f2m": ("0.500 (1 of 2)", "-"),
        "cv+p_f2m (Somebody 2020)": ("0.7", "-"),
    }
    notes = " ".join(table.notes)
    assert "seen: a, b." in notes and "trained on these" in notes and "only so many" in notes


def test_failures_are_summed():
    table = TableLayout("t", COLUMNS, "registration_failures").table(SCORES)
    assert cells(table)["posenet_icp+p_f2m"] == ("7", "1")
    assert any("the sum over" in note for note in table.notes)


def test_cell_partly_seen_in_training_is_not_marked():
    table = TableLayout("t", COLUMNS).table(SCORES, {("posenet_icp+p_f2m", "a")})
    assert cells(table)["posenet_icp+p_f2m"] == ("2.000", "9.000")


def test_layout_refuses_unknown_figure_and_wrong_value_count():
    with pytest.raises(ValueError, match=r"table\.figure=ate"):
        TableLayout("t", COLUMNS, "ate")
    with pytest.raises(ValueError, match=r"published\.m: 1 values for 2 columns"):
        TableLayout("t", COLUMNS, published={"m": [1.0]})
