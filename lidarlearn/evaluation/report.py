"""Reports of an evaluation: results.json for programs, results.md and the terminal for people."""

import json
import math
from collections.abc import Callable, Collection, Iterable, Mapping
from dataclasses import asdict
from os import PathLike
from pathlib import Path
from typing import Any

from rich.console import Console

from lidarlearn.evaluation.published import published_beside, whole_kitti_sequences
from lidarlearn.evaluation.score import Averages, Score, average_scores
from lidarlearn.evaluation.table_layout import TableLayout
from lidarlearn.evaluation.tables import Table

_UNDEFINED = "-"
_PIPE_WIDTH = 200  # characters per line, if the output is not a terminal

_DETAILS_NOTES = {
    "rot. [deg/100 m]": "rot.: average rotation error, KITTI metric.",
    "APE [m]": "APE: position after rigid alignment of the whole trajectory, RMSE.",
    "RPE [cm]": "RPE: motion between consecutive scans, RMSE unless it says mean.",
    "motion [%]": "motion: mean error of that motion over its mean length.",
    "fails": "fails: registration failures, motions off by more than 1 m or 3 deg.",
    "flagged": "flagged: scans whose pose the odometry itself doubts, see the .health.csv files.",
}

Seen = Collection[tuple[str, str]]  # methods and sequences on which their networks were trained


def write_report(
    folder: Path,
    protocol: Mapping[str, Any],
    scores: list[Score],
    layout: TableLayout | None = None,
) -> list[Table]:
    """Write `results.json` and `results.md` into a folder.

    Args:
        folder: the run folder, created if missing.
        protocol: how the scores were obtained: plain values, paths, and nested mappings and lists of these.
            `protocol["data"]` is the name of the data group.
        scores: scores of all methods on all sequences, in the order of the rows.
        layout: the table of an experiment; None for no such table.

    Returns:
        The tables in `results.md`.
    """
    results = {"protocol": protocol, **results_content(scores)}
    if layout is not None:
        results["table"] = asdict(layout)
    tables = report_tables(str(protocol.get("data", "")), scores, seen_in_training(protocol, scores), layout)
    write_results(folder, results, tables, _protocol_markdown(protocol))
    return tables


def write_results(folder: Path, results: Mapping[str, Any], tables: list[Table], closing: str) -> None:
    """Write `results.json`, and `results.md` with the tables and a closing section.

    Raises:
        TypeError: `results` holds a value that JSON does not support.
    """
    folder.mkdir(parents=True, exist_ok=True)
    text = json.dumps(_plain(results), indent=2, allow_nan=False, ensure_ascii=False)
    (folder / "results.json").write_text(text + "\n", encoding="utf-8")
    body = "\n".join(table.markdown() for table in tables)
    (folder / "results.md").write_text(f"# Results\n\n{body}\n{closing}", encoding="utf-8")


def seen_in_training(protocol: Mapping[str, Any], scores: Iterable[Score]) -> set[tuple[str, str]]:
    """The scored methods and sequences where the network of the method was trained on the sequence."""
    networks = {"posenet": protocol.get("checkpoint"), **protocol.get("networks", {})}
    names = {name: network["trained_on"]["train_sequences"] or () for name, network in networks.items() if network}
    rows = ((row.method, row.sequence) for row in scores)
    return {(method, sequence) for method, sequence in rows if sequence in names.get(method.partition("+")[0], ())}


def results_content(scores: list[Score]) -> dict[str, Any]:
    """Scores and their averages, as in `results.json`."""
    averages = average_scores(scores)
    return {"results": [asdict(row) for row in scores], "averages": [asdict(row) for row in averages]}


def print_tables(tables: list[Table], console: Console | None = None) -> None:
    """Print tables to a console; None takes the standard output."""
    out = console or Console()
    if console is None and not out.is_terminal:
        out = Console(width=_PIPE_WIDTH)
    for table in tables:
        table.print(out)


def report_tables(data: str, scores: list[Score], seen: Seen = (), layout: TableLayout | None = None) -> list[Table]:
    """All tables of a report.

    First the experiment's table, if any; then, if any sequence has ground truth, the paper's kind of table, with one
    column per sequence; last all other metrics, with one row per method and sequence.

    Args:
        data: name of the data group.
        scores: scores of all methods on all sequences, in the order of the rows.
        seen: methods and sequences on which their networks were trained.
        layout: the table of an experiment; None for no such table.
    """
    tables = [details_table(scores)]
    if any(row.path_length_m is not None for row in scores):
        tables.insert(0, drift_table(data, scores, seen))
    return tables if layout is None else [layout.table(scores, seen), *tables]


def drift_table(data: str, scores: list[Score], seen: Seen = ()) -> Table:
    """Average translation error of each method on each sequence, both averages, and published rows for KITTI."""
    sequences = list(dict.fromkeys(row.sequence for row in scores))
    cells = {(row.method, row.sequence): _drift_cell(row, seen) for row in scores}
    averages = average_scores(scores)
    complete = max((row.mean_over_sequences.sequences for row in averages), default=0)
    rows = [
        (row.method, *(cells.get((row.method, name), _UNDEFINED) for name in sequences), *_means(row, complete))
        for row in averages
    ]
    reference = _reference_rows(data, scores, sequences)
    columns = ("method", *sequences, "mean of sequences", "mean of segments")
    shown = slice(len(columns) if len(sequences) > 1 else -2)  # the means of one sequence are its own figure
    return Table(
        title="Average translation error [%], KITTI metric",
        columns=columns[shown],
        rows=tuple(row[shown] for row in rows),
        reference=tuple(row[shown] for row in reference),
        notes=tuple(_drift_notes(scores, rows, bool(reference))),
        lowest=frozenset(range(1, len(columns[shown]))),
    )


def details_table(scores: list[Score]) -> Table:
    """All other metrics that are defined for any row; one row per method and sequence."""
    columns: dict[str, Callable[[Score], str]] = {
        "method": lambda row: row.method,
        "sequence": lambda row: row.sequence,
        "scans": lambda row: str(row.frames),
        "path [m]": lambda row: _text(row.path_length_m, 1),
        "rot. [deg/100 m]": lambda row: _text(row.avg_rotation_error_deg_per_100m, 3),
        "APE [m]": lambda row: _text(row.ape_rmse_m, 3),
        "RPE [cm]": lambda row: _text(row.rpe_translation_m, 2, 100.0),
        "RPE mean [cm]": lambda row: _text(row.rpe_translation_mean_m, 2, 100.0),
        "RPE [deg]": lambda row: _text(row.rpe_rotation_deg, 3),
        "motion [%]": lambda row: _text(row.relative_translation_error_percent, 2),
        "fails": lambda row: _text(row.registration_failures, 0),
        "flagged": lambda row: _text(row.health.get("flagged"), 0),
        "scans/s": lambda row: _text(row.frames_per_second, 1),
    }
    cells = {heading: [cell(row) for row in scores] for heading, cell in columns.items()}
    cells = {heading: column for heading, column in cells.items() if set(column) != {_UNDEFINED}}
    notes = [note for heading, note in _DETAILS_NOTES.items() if heading in cells]
    return Table(
        title="Further errors, and speed" if "path [m]" in cells else "Scans, and speed: there is no ground truth",
        columns=tuple(cells),
        rows=tuple(zip(*cells.values(), strict=True)),
        notes=(" ".join(notes),) if notes else (),
        labels=2,
    )


def _drift_cell(row: Score, seen: Seen) -> str:
    """The percentage or, for drives too short for it, the mean error between scans in brackets."""
    star = "*" if (row.method, row.sequence) in seen else ""
    if row.avg_translation_error_percent is not None:
        return _text(row.avg_translation_error_percent, 3) + star
    if row.rpe_translation_mean_m is not None:
        return f"{_UNDEFINED} ({_text(row.rpe_translation_mean_m, 2, 100.0)} cm){star}"
    return _UNDEFINED


def _means(row: Averages, complete: int) -> tuple[str, str]:
    """Both averages, with the number of sequences if other methods have more."""
    counted = row.mean_over_sequences.sequences
    suffix = f" ({counted} of {complete})" if 0 < counted < complete else ""
    over_sequences = row.mean_over_sequences.avg_translation_error_percent
    over_segments = row.mean_over_segments.avg_translation_error_percent
    return _text(over_sequences, 3) + suffix, _text(over_segments, 3) + suffix


def _reference_rows(data: str, scores: list[Score], sequences: list[str]) -> list[tuple[str, ...]]:
    """Published rows for whole KITTI sequences; averages only if over the same sequences as ours."""
    whole = whole_kitti_sequences(data, scores)
    averaged = list(dict.fromkeys(row.sequence for row in scores if row.segments))
    rows = []
    for published in published_beside(whole):
        errors = published.errors_percent
        mean = published.sequence_mean_percent(averaged) if set(averaged) <= set(whole) else None
        pooled = published.segment_mean_percent if len(averaged) == len(whole) == 11 else ""
        cells = (errors.get(name, _UNDEFINED) if name in whole else _UNDEFINED for name in sequences)
        rows.append((f"{published.method} (published)", *cells, _text(mean, 3), pooled or _UNDEFINED))
    return rows


def _drift_notes(scores: list[Score], rows: list[tuple[str, ...]], has_reference: bool) -> list[str]:
    notes = ["Mean over segments of 100 to 800 m."]
    if len({row.sequence for row in scores}) > 1:
        notes[0] += (
            " Two averages are in use: every sequence counts the same (mean of sequences), or every segment of all "
            "sequences (mean of segments), as on the KITTI benchmark."
        )
    if any(row.segments == 0 for row in scores):
        notes.append(
            "- (x cm): the drive holds no segment of 100 m, so the metric is not defined; in brackets the mean "
            "error of the translation between consecutive scans."
        )
    if any(row.path_length_m is None for row in scores):
        notes.append("-: no ground truth.")
    if any(cell.endswith("*") for row in rows for cell in row):
        notes.append("*: the network was trained on this sequence.")
    if has_reference:
        notes.append(
            "published: as printed by the authors or re-run by others, for whole sequences; not measured here. Numbers "
            "after the name of a network are the sequences that it was trained on."
        )
    return notes


def _protocol_markdown(protocol: Mapping[str, Any]) -> str:
    """The closing section of `results.md`: how the results were obtained."""
    plain = {key: _plain(value) for key, value in protocol.items()}
    texts = {k: v if isinstance(v, str) else json.dumps(v, ensure_ascii=False) for k, v in plain.items()}
    return "### Protocol\n\n" + "".join(f"- {key}: {text}\n" for key, text in texts.items())


def _text(value: float | int | None, digits: int, scale: float = 1.0) -> str:
    return _UNDEFINED if value is None or not math.isfinite(value) else f"{scale * value:.{digits}f}"


def _plain(value: Any) -> Any:
    """The value in types that JSON has; floats that are not finite are undefined and become null."""
    if isinstance(value, Mapping):
        return {str(key): _plain(item) for key, item in value.items()}
    if isinstance(value, (list, tuple)):
        return [_plain(item) for item in value]
    if isinstance(value, PathLike):
        return str(value)
    if isinstance(value, float) and not math.isfinite(value):
        return None
    return value
