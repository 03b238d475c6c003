from io import StringIO

from rich.console import Console

from lidarlearn.evaluation.tables import Table

TABLE = Table(
    title="Error [%]",
    columns=("method", "00 [m]", "mean"),
    rows=(("a|b", "0.50", "1.00 (1 of 2)"), ("c", "0.25", "2.00"), ("d", "-", "3.00")),
    reference=(("other (published)", "0.1", "-"),),
    notes=("-: not defined.",),
    lowest=frozenset({1, 2}),
)


def test_markdown():
    assert TABLE.markdown().splitlines() == [
        "### Error [%]",
        "",
        "| method            |   00 [m] |          mean |",
        "| ----------------- | -------: | ------------: |",
        "| a\\|b              |     0.50 | 1.00 (1 of 2) |",
        "| c                 | **0.25** |      **2.00** |",
        "| d                 |        - |          3.00 |",
        "| other (published) |      0.1 |             - |",
        "",
        "-: not defined.",
    ]


def test_a_single_figure_is_not_the_best_of_anything():
    alone = Table("t", ("method", "00"), (("a", "0.50"), ("b", "-")), lowest=frozenset({1}))
    assert "*" not in alone.markdown()


def test_equal_figures_are_both_marked():
    tied = Table("t", ("method", "00"), (("a", "0.50"), ("b", "0.50"), ("c", "0.60")), lowest=frozenset({1}))
    assert tied.markdown().count("**0.50**") == 2


def test_the_terminal_shows_the_same_cells_brackets_and_all():
    out = StringIO()
    TABLE.print(Console(file=out, width=80))
    text = out.getvalue()
    headings = [word for column in TABLE.columns for word in column.split()]
    for cell in (*headings, *(cell for row in (*TABLE.rows, *TABLE.reference) for cell in row), *TABLE.notes):
        assert cell in text
    assert "Error [%]" in text


def test_a_narrow_terminal_wraps_labels_and_not_methods_and_figures():
    out = StringIO()
    table = Table("t", ("method", "seq", "a [m]"), (("posenet+p_f2m", "simulated_urban", "123.456"),), labels=2)
    table.print(Console(file=out, width=32))
    assert any("posenet+p_f2m" in line and "123.456" in line for line in out.getvalue().splitlines())
    assert "simulated_urban" not in out.getvalue()


def test_a_table_without_rows_prints():
    out = StringIO()
    empty = Table("t", ("method", "00"), (), lowest=frozenset({1}))
    empty.print(Console(file=out, width=36))
    assert "method" in out.getvalue()
    assert "| method |  00 |" in empty.markdown()
