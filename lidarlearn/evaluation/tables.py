"""A table as text: the same for a Markdown file and for the terminal."""

from dataclasses import dataclass, field, replace
from typing import Literal

from rich.box import SIMPLE_HEAD
from rich.console import Console
from rich.table import Table as RichTable
from rich.text import Text

_LEGIBLE = 4  # letters of a folded heading or label that a line has at least


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
        """Print it to a terminal; columns that find no room beside the others come below them, labels repeated."""
        console.print(Text(self.title, "bold"))  # not the table's own title, which folds with a narrow table
        for block in self._blocks(console.width):
            console.print(block._set_for(console.width))
        for note in self.notes:
            console.print(Text(note, "dim"))

    def _set_for(self, available: int) -> RichTable:
        """All columns as the terminal takes them."""
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

    def _blocks(self, available: int) -> list["Table"]:
        """The whole table where no figure has to fold, else as many columns at a time as fit beside the labels."""
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
        return [self._only(columns) for columns in chosen]

    def _only(self, chosen: list[int]) -> "Table":
        return replace(
            self,
            columns=tuple(self.columns[i] for i in chosen),
            rows=tuple(tuple(row[i] for i in chosen) for row in self.rows),
            reference=tuple(tuple(row[i] for i in chosen) for row in self.reference),
            lowest=frozenset(k for k, i in enumerate(chosen) if i in self.lowest),
        )

    def _extents(self) -> tuple[list[int], list[int]]:
        """Width of each column at which nothing folds, and that at which labels and headings do, but no figure."""
        widest, least = [], []
        for i, heading in enumerate(self._headings()):
            own = max((len(row[i]) for row in self.rows), default=1)
            whole = max(own, *(len(row[i]) for row in self.reference), 1)
            widest.append(max(whole, *map(len, heading.split("\n"))))
            legible = min(widest[i], _LEGIBLE)
            least.append(own if i == 0 else legible if i < self.labels else max(whole, legible))
        return widest, least

    def _widths(self, available: int) -> list[int]:
        """Width of each column in a terminal: where it is narrow labels and headings fold, but no method or figure."""
        widths, least = self._extents()
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
