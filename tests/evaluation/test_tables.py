from io import StringIO

import pytest
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


def test_markdown_table():
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


def test_single_figure_is_not_marked_as_best():
    alone = Table("t", ("method", "00"), (("a", "0.50"), ("b", "-")), lowest=frozenset({1}))
    assert "*" not in alone.markdown()


def test_equal_best_figures_are_both_marked():
    tied = Table("t", ("method", "00"), (("a", "0.50"), ("b", "0.50"), ("c", "0.60")), lowest=frozenset({1}))
    assert tied.markdown().count("**0.50**") == 2


def test_terminal_shows_all_cells():
    out = StringIO()
    TABLE.print(Console(file=out, width=80))
    text = out.getvalue()
    headings = [word for column in TABLE.columns for word in column.split()]
    for cell in (*headings, *(cell for row in (*TABLE.rows, *TABLE.reference) for cell in row), *TABLE.notes):
        assert cell in text
    assert "Error [%]" in text


def test_narrow_terminal_wraps_labels_alone():
    out = StringIO()
    table = Table("t", ("method", "seq", "a [m]"), (("posenet+p_f2m", "simulated_urban", "123.456"),), labels=2)
    table.print(Console(file=out, width=32))
    assert any("posenet+p_f2m" in line and "123.456" in line for line in out.getvalue().splitlines())
    assert "simulated_urban" not in out.getvalue()


@pytest.mark.parametrize("width", [40, 60, 80, 100])
def test_columns_that_do_not_fit_are_printed_below(width):
    names = [f"{i:02d}" for i in range(11)]
    figures = [f"{100 + i}.{i:03d}*" for i in range(11)]
    reference = ("a method of somebody (published)", *(f"{i}.25" for i in range(11)))
    table = Table("Error [%]", ("method", *names), (("posenet+p_f2m", *figures),), (reference,), lowest=frozenset({11}))
    out = StringIO()
    table.print(Console(file=out, width=width))
    lines = out.getvalue().splitlines()
    assert max(map(len, lines)) <= width
    printed = [line for line in lines if "posenet+p_f2m" in line]
    assert [word for line in printed for word in line.split()[1:]] == figures
    headings = [word for line in lines if line.split()[:1] == ["method"] for word in line.split()[1:]]
    assert headings == names and out.getvalue().count("Error [%]") == 1
    assert all(figure in out.getvalue() for figure in reference[1:])


def test_best_figures_stay_marked_in_columns_printed_below():
    table = Table(
        "t", ("method", "00", "01"), (("long+name", "0.5", "0.7"), ("b", "0.6", "0.2")), lowest=frozenset({1, 2})
    )
    out = StringIO()
    table.print(Console(file=out, width=17, force_terminal=True, color_system="standard"))
    text = out.getvalue()
    assert text.count("method") == 2 and all(f"\x1b[1m{figure}" in text for figure in ("0.5", "0.2"))


def test_table_without_rows_is_printed():
    out = StringIO()
    empty = Table("t", ("method", "00"), (), lowest=frozenset({1}))
    empty.print(Console(file=out, width=36))
    assert "method" in out.getvalue()
    assert "| method |  00 |" in empty.markdown()
