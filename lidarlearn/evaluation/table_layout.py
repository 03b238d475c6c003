"""Tables as in a paper: a column for each group of sequences, one metric, published values below."""

from collections.abc import Collection, Mapping
from dataclasses import dataclass, field

from lidarlearn.evaluation.score import MeanOverSequences, Score, average_scores
from lidarlearn.evaluation.tables import Table

_FIGURES = {
    "avg_translation_error_percent": ("average translation error [%]", 3),
    "relative_translation_error_percent": ("mean error of the motion between scans [% of the mean motion]", 2),
    "registration_failures": ("registration failures, motions off by more than 1 m or 3 deg", 0),
    "ape_rmse_m": ("absolute pose error, RMSE [m]", 3),
}


@dataclass(frozen=True)
class TableLayout:
    """The layout of an experiment's table.

    Args:
        title: what is compared, and in which table of which paper.
        columns: headings of the columns, with the names of their sequences.
        figure: the metric in the cells, a field of `MeanOverSequences`: its mean over the sequences of the column, or
            the sum of failures.
        published: values reported by others, by method and in the order of the columns; None where not reported.
        source: where the published values come from, and on which data.

    Raises:
        ValueError: a table cannot show the metric, or a published row does not match the columns.
    """

    title: str
    columns: Mapping[str, Collection[str]]
    figure: str = "avg_translation_error_percent"
    published: Mapping[str, Collection[float | int | None]] = field(default_factory=dict)
    source: str = "published"

    def __post_init__(self) -> None:
        if self.figure not in _FIGURES:
            raise ValueError(f"table.figure={self.figure}: choose one of {', '.join(_FIGURES)}")
        for method, values in self.published.items():
            if len(values) != len(self.columns):
                raise ValueError(f"table.published.{method}: {len(values)} values for {len(self.columns)} columns")

    def table(self, scores: list[Score], seen: Collection[tuple[str, str]] = ()) -> Table:
        """The table of measured scores.

        Args:
            scores: scores of all methods on all sequences.
            seen: methods and sequences on which their networks were trained.
        """
        what, digits = _FIGURES[self.figure]
        methods = dict.fromkeys(row.method for row in scores)
        rows = [(m, *(self._cell(m, names, scores, seen, digits) for names in self.columns.values()))
                for m in methods]  # fmt: skip
        reference = [
            (f"{method} ({self.source})", *("-" if value is None else f"{value:g}" for value in values))
            for method, values in self.published.items()
        ]
        pooled = "sum" if self.figure == "registration_failures" else "mean"
        notes = [f"Each cell: {what}; the {pooled} over the sequences of its column."]
        notes += [f"{heading}: {', '.join(names)}." for heading, names in self.columns.items() if heading not in names]
        if any("*" in cell for row in rows for cell in row):
            notes.append("*: the network was trained on these sequences.")
        if any("(" in cell for row in rows for cell in row[1:]):
            notes.append("(n of m): only so many of the sequences were run and are long enough for the figure.")
        return Table(self.title, ("method", *self.columns), tuple(rows), tuple(reference), tuple(notes),
                     lowest=frozenset(range(1, len(self.columns) + 1)))  # fmt: skip

    def _cell(
        self,
        method: str,
        names: Collection[str],
        scores: list[Score],
        seen: Collection[tuple[str, str]],
        digits: int,
    ) -> str:
        of_method = [row for row in scores if row.method == method and row.sequence in names]
        rows = [row for row in of_method if getattr(row, self.figure) is not None]
        if not rows:
            return "-"
        mean: MeanOverSequences = average_scores(rows)[0].mean_over_sequences
        value = getattr(mean, self.figure)
        star = "*" if all((method, row.sequence) in seen for row in rows) else ""
        run = len({row.sequence for row in rows})
        return f"{value:.{digits}f}{star}" + (f" ({run} of {len(names)})" if run < len(names) else "")
