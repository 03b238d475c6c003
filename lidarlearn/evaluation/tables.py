"""A table as text: the same for a Markdown file and for the terminal."""

from dataclasses import dataclass, field, replace
from typing import Literal

from rich.box import SIMPLE_HEAD
from rich.console import Console
from rich.table import Table as RichTable
from rich.text import Text

_LEGIBLE = 4  # fewest letters in a line of a folded heading or label


@dataclass(frozen=True)
class Table:
    """A table whose cells are text.

    Args:
        title: what the table shows, with the unit.
        columns: headings of the columns.
        rows: the cells of each row, one per column.
        reference: rows to compare with, which were not measured here; shown below the others.
        notes: lines below the table.
        labels: number of leading columns that name the row; they are left-aligned.
        lowest: columns whose lowest number in `rows` is bold; cells with more than a number are ignored.
    """

    title: str
    columns: tuple[str, ...]
    rows: tuple[tuple[str, ...], ...]
    reference: tuple[tuple[str, ...], ...] = ()
    notes: tuple[str, ...] = ()
    labels: int = 1
    lowest: frozenset[int] = field(default_factory=frozenset)

    def markdown(self) -> str:
        """The table in GitHub's Markdown, with aligned columns, so that it also reads as plain text."""
        best = self._lowest()
        bold = [tuple(f"**{c}**" if c == best.get(i) else c for i, c in enumerate(row)) for row in self.rows]
        lines = [tuple(cell.replace("|", "\\|") for cell in row) for row in (self.columns, *bold, *self.reference)]
        widths = [max(3, *(len(cell) for cell in column)) for column in zip(*lines, strict=True)]
        lines.insert(1, tuple("-" * w if i < self.labels else "-" * (w - 1) + ":" for i, w in enumerate(widths)))
        text = "\n".join("| " + " | ".join(self._padded(row, widths)) + " |" for row in lines)
        return f"### {self.title}\n\n{text}\n" + "".join(f"\n{note}\n" for note in self.notes)

    def print(self, console: Console) -> None:
        """Print to a terminal; columns that do not fit beside the others come below, with the labels repeated."""
        console.print(Text(self.title, "bold"))  # a `RichTable.title` would be folded to the width of the table
        for block in self._blocks(console.width):
            console.print(block._rich_table(console.width))
        for note in self.notes:
            console.print(Text(note, "dim"))

    def _rich_table(self, available: int) -> RichTable:
        """All columns, for a terminal of this width."""
        widths = self._widths(available)
        roomy = sum(widths) + 2 * len(widths) < available
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
        return table

    def _lowest(self) -> dict[int, str]:
        """The cell with the lowest number in each column of `lowest` that has different numbers."""
        best = {}
        for i in self.lowest:
            numbers = {row[i]: value for row in self.rows if (value := _number(row[i])) is not None}
            if len(numbers) > 1:
                best[i] = min(numbers, key=lambda cell: numbers[cell])
        return best

    def _headings(self) -> list[str]:
        """Headings for narrow columns: one word per line, except above labels."""
        return [c if i < self.labels else c.replace(" ", "\n") for i, c in enumerate(self.columns)]

    def _blocks(self, available: int) -> list["Table"]:
        """The whole table if no number must fold; else tables of as many columns as fit beside the labels."""
        widest, least = self._extents()
        if sum(least) + len(least) + 1 <= available:
            return [self]
        beside_labels = available - 1 - sum(width + 1 for width in (least[0], *widest[1 : self.labels]))
        chosen: list[list[int]] = []
        room = 0
        for i in range(self.labels, len(self.columns)):
            if widest[i] + 1 > room:
                chosen.append([*range(self.labels)])
                room = beside_labels
            chosen[-1].append(i)
            room -= widest[i] + 1
        return [self._with_columns(columns) for columns in chosen]

    def _with_columns(self, chosen: list[int]) -> "Table":
        return replace(
            self,
            columns=tuple(self.columns[i] for i in chosen),
            rows=tuple(tuple(row[i] for i in chosen) for row in self.rows),
            reference=tuple(tuple(row[i] for i in chosen) for row in self.reference),
            lowest=frozenset(k for k, i in enumerate(chosen) if i in self.lowest),
        )

    def _extents(self) -> tuple[list[int], list[int]]:
        """The widths of the columns at which nothing folds, and those at which only labels and headings fold."""
        widest, least = [], []
        for i, heading in enumerate(self._headings()):
            own = max((len(row[i]) for row in self.rows), default=1)
            whole = max(own, *(len(row[i]) for row in self.reference), 1)
            widest.append(max(whole, *map(len, heading.split("\n"))))
            legible = min(widest[i], _LEGIBLE)
            least.append(own if i == 0 else legible if i < self.labels else max(whole, legible))
        return widest, least

    def _widths(self, available: int) -> list[int]:
        """The widths of the columns in a terminal: if narrow, labels and headings fold, but no method or number."""
        widths, least = self._extents()
        excess = sum(widths) + len(widths) + 1 - available  # with a space on either side of each column
        for i in sorted(range(len(widths)), key=lambda i: least[i] - widths[i]):
            cut = max(0, min(excess, widths[i] - least[i]))
            widths[i] -= cut
            excess -= cut
        return widths

    def _padded(self, row: tuple[str, ...], widths: list[int]) -> list[str]:
        pairs = zip(row, widths, strict=True)
        return [cell.ljust(w) if i < self.labels else cell.rjust(w) for i, (cell, w) in enumerate(pairs)]


def _number(cell: str) -> float | None:
    try:
        return float(cell)
    except ValueError:
        return None
