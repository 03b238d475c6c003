"""A table as text: the same for a Markdown file and for the terminal."""

from dataclasses import dataclass, field
from typing import Literal

from rich.box import SIMPLE_HEAD
from rich.console import Console
from rich.table import Table as RichTable
from rich.text import Text


@dataclass(frozen=True)
class Table:
    """A table of finished text.

    Args:
        title: what the figures are, with their unit.
        columns: headings; the first `labels` of them name the rows.
        rows: cells, as many as there are columns.
        reference: rows to compare with that were not measured here, set apart below the others.
        notes: one line each, below the table.
        labels: number of columns that name a row, set flush left.
        lowest: columns whose lowest figure among `rows` is set in bold; cells that say more than a figure stay out.
    """

    title: str
    columns: tuple[str, ...]
    rows: tuple[tuple[str, ...], ...]
    reference: tuple[tuple[str, ...], ...] = ()
    notes: tuple[str, ...] = ()
    labels: int = 1
    lowest: frozenset[int] = field(default_factory=frozenset)

    def markdown(self) -> str:
        """The table in GitHub's Markdown, columns aligned for reading as plain text too."""
        best = self._lowest()
        bold = [tuple(f"**{c}**" if c == best.get(i) else c for i, c in enumerate(row)) for row in self.rows]
        lines = [tuple(cell.replace("|", "\\|") for cell in row) for row in (self.columns, *bold, *self.reference)]
        widths = [max(3, *(len(cell) for cell in column)) for column in zip(*lines, strict=True)]
        lines.insert(1, tuple("-" * w if i < self.labels else "-" * (w - 1) + ":" for i, w in enumerate(widths)))
        text = "\n".join("| " + " | ".join(self._padded(row, widths)) + " |" for row in lines)
        return f"### {self.title}\n\n{text}\n" + "".join(f"\n{note}\n" for note in self.notes)

    def print(self, console: Console) -> None:
        """Print it to a terminal."""
        widths = self._widths(console.width)
        roomy = sum(widths) + 2 * len(widths) < console.width
        table = RichTable(box=SIMPLE_HEAD, padding=(0, int(roomy), 0, 0))
        best = self._lowest()
        for i, (column, width) in enumerate(zip(self._headings(), widths, strict=True)):
            justify: Literal["left", "right"] = "left" if i < self.labels else "right"
            table.add_column(Text(column), justify=justify, width=width, overflow="fold")
        for row in self.rows:
            table.add_row(*(Text(cell, "bold" if cell == best.get(i) else "") for i, cell in enumerate(row)))
        if self.reference:
            table.add_section()
        for row in self.reference:
            table.add_row(*map(Text, row), style="dim")
        console.print(Text(self.title, "bold"))  # not the table's own title, which folds with a narrow table
        console.print(table)
        for note in self.notes:
            console.print(Text(note, "dim"))

    def _lowest(self) -> dict[int, str]:
        """The cell of the lowest figure in each chosen column that has several."""
        best = {}
        for i in self.lowest:
            figures = {row[i]: value for row in self.rows if (value := _figure(row[i])) is not None}
            if len(figures) > 1:
                best[i] = min(figures, key=lambda cell: figures[cell])
        return best

    def _headings(self) -> list[str]:
        """Headings for narrow columns: a word a line above figures."""
        return [c if i < self.labels else c.replace(" ", "\n") for i, c in enumerate(self.columns)]

    def _widths(self, available: int) -> list[int]:
        """Width of each column in a terminal: where it is narrow labels and headings fold, but no method or figure."""
        widths, least = [], []
        for i, heading in enumerate(self._headings()):
            own = max((len(row[i]) for row in self.rows), default=1)
            widths.append(max(own, *map(len, heading.split("\n")), *(len(row[i]) for row in self.reference)))
            least.append(own if i == 0 or i >= self.labels else min(own, 4))
        excess = sum(widths) + len(widths) + 1 - available  # a space around each
        for i in sorted(range(len(widths)), key=lambda i: least[i] - widths[i]):
            cut = max(0, min(excess, widths[i] - least[i]))
            widths[i] -= cut
            excess -= cut
        return widths

    def _padded(self, row: tuple[str, ...], widths: list[int]) -> list[str]:
        pairs = zip(row, widths, strict=True)
        return [cell.ljust(w) if i < self.labels else cell.rjust(w) for i, (cell, w) in enumerate(pairs)]


def _figure(cell: str) -> float | None:
    try:
        return float(cell)
    except ValueError:
        return None
