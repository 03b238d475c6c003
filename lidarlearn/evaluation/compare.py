"""Results of several runs side by side: what was measured under the same protocol in one table, the rest apart."""

import itertools
import json
from collections.abc import Iterable, Mapping, Set
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from lidarlearn.errors import UserError
from lidarlearn.evaluation.report import report_tables, results_content, seen_in_training
from lidarlearn.evaluation.run import Export
from lidarlearn.evaluation.score import Score
from lidarlearn.evaluation.table_layout import TableLayout
from lidarlearn.evaluation.tables import Table
from lidarlearn.metrics.kitti import SegmentAverage

# Two results are comparable where these agree...
_PROTOCOL = ("beam_correction_deg", "deskew", "max_frames")
# ...and these of the sequences that they share; results of earlier versions tell nothing of the ground truth.
_OF_SEQUENCES = {"scans": "scans", "ground_truth": "ground truth"}

_DIGESTS = ("network", "code")  # settings of which a few digits are enough to tell them apart

Settings = dict[str, Any]  # dotted keys and plain values


@dataclass(frozen=True)
class Run:
    """What an evaluation left in its folder.

    Args:
        folder: the run folder.
        protocol: of `results.json`.
        scores: its rows.
        settings: what each method and sequence was run with; nothing for trajectories of other tools.
        layout: how its experiment sums up the sequences.
    """

    folder: Path
    protocol: Mapping[str, Any]
    scores: list[Score]
    settings: Mapping[tuple[str, str], Settings]
    layout: TableLayout | None = None


@dataclass(frozen=True)
class Group:
    """Runs that are comparable, as one table.

    Args:
        runs: in the order given.
        scores: all rows; where the same method was run with different settings, its name says which.
        seen: methods, by these names, and sequences on which their networks were trained.
    """

    runs: list[Run]
    scores: list[Score]
    seen: Set[tuple[str, str]]

    @property
    def title(self) -> str:
        """Data and protocol in a line."""
        protocol = self.runs[0].protocol
        data = ", ".join(dict.fromkeys(str(run.protocol.get("data")) for run in self.runs))
        return f"{data}: " + ", ".join(f"{key} {json.dumps(protocol.get(key))}" for key in _PROTOCOL)

    def tables(self, layout: TableLayout | None = None) -> list[Table]:
        """The same tables as of a single evaluation."""
        return report_tables(str(self.runs[0].protocol.get("data", "")), self.scores, self.seen, layout)


def read_run(folder: Path) -> Run:
    """Read a run folder.

    Raises:
        UserError: it holds no results of an evaluation.
    """
    path = folder / "results.json"
    if not path.is_file():
        raise UserError(f"{path.absolute()}: no such file\n  change: name run folders of evaluate.py")
    try:
        content = json.loads(path.read_text(encoding="utf-8"))
        scores = [_score(row) for row in content["results"]]
        protocol = content["protocol"]
        layout = TableLayout(**content["table"]) if "table" in content else None
    except (OSError, ValueError, KeyError, TypeError) as problem:
        raise UserError(
            f"{path.absolute()}: not the result of an evaluation ({type(problem).__name__}: {problem})\n"
            "  change: name run folders of evaluate.py"
        ) from problem
    settings = {}
    for row in scores:
        found = Export(folder / "trajectories" / row.method, row.sequence).settings()
        settings[row.method, row.sequence] = _flat({k: v for k, v in (found or {}).items() if k != "scans"})
    return Run(folder, protocol, scores, settings, layout)


def differences(a: Run, b: Run) -> list[str]:
    """Why two runs are not comparable; nothing where they are."""
    found = [
        f"{key}: {json.dumps(a.protocol.get(key))} against {json.dumps(b.protocol.get(key))}"
        for key in _PROTOCOL
        if a.protocol.get(key) != b.protocol.get(key)
    ]
    if found:
        return found  # which is why the following differs, too
    for key, what in _OF_SEQUENCES.items():
        mine, theirs = a.protocol.get(key, {}), b.protocol.get(key, {})
        other = [name for name in mine if name in theirs and mine[name] != theirs[name]]
        if other:
            found.append(f"not the same {what} of sequence {', '.join(other)}")
    return found


def comparable_groups(runs: Iterable[Run]) -> list[Group]:
    """Runs sorted into groups, within each of which all are comparable."""
    groups: list[list[Run]] = []
    for run in runs:
        group = next((g for g in groups if not any(differences(other, run) for other in g)), None)
        if group is None:
            groups.append([run])
        else:
            group.append(run)
    return [_group(runs) for runs in groups]


def comparison(groups: list[Group]) -> tuple[dict[str, Any], list[Table], str]:
    """What to write and print about groups of runs: content of `results.json`, tables, and a last section.

    Where all runs are of one experiment, its table comes first, with the rows of all of them; or one for each group, if
    two of them measured the same.
    """
    content = {
        "compared": [
            {"runs": [{"folder": run.folder, "protocol": run.protocol} for run in group.runs],
             **results_content(group.scores)}
            for group in groups
        ]
    }  # fmt: skip
    layouts = [run.layout for group in groups for run in group.runs]
    layout = layouts[0] if all(other == layouts[0] for other in layouts) else None
    scores = [row for group in groups for row in group.scores]
    tables = []
    if layout is not None and len({(row.method, row.sequence) for row in scores}) == len(scores):
        tables.append(layout.table(scores, {pair for group in groups for pair in group.seen}))
        layout = None  # of each group
    for i, group in enumerate(groups):
        heading = "" if len(groups) == 1 else f" ({i + 1} of {len(groups)}: {group.title})"
        tables += [replace(table, title=table.title + heading) for table in group.tables(layout)]
    return content, tables, _closing(groups)


def _closing(groups: list[Group]) -> str:
    lines = ["### Runs", ""]
    for i, group in enumerate(groups):
        prefix = "" if len(groups) == 1 else f"{i + 1}. "
        lines.append(f"{prefix}{group.title}")
        lines += [f"   - {run.folder}: {_measured_with(run)}" for run in group.runs]
    lines += [
        f"\nNot comparable: {i + 1} and {k + 1}, {'; '.join(differences(a.runs[0], b.runs[0]))}."
        for i, a in enumerate(groups)
        for k, b in enumerate(groups[i + 1 :], i + 1)
        if differences(a.runs[0], b.runs[0])
    ]
    return "\n".join(lines) + "\n"


def _measured_with(run: Run) -> str:
    keys = ("lidarlearn", "git", "torch", "device", "seed")
    return ", ".join(f"{key} {run.protocol[key]}" for key in keys if key in run.protocol)


def _group(runs: list[Run]) -> Group:
    """All rows, sequence by sequence within each method."""
    by_method: dict[str, dict[str, list[Score]]] = {}
    seen = set()
    for run, labels in zip(runs, _labels(runs), strict=True):
        for row in run.scores:
            label = labels[row.method, row.sequence]
            by_method.setdefault(row.method, {}).setdefault(label, []).append(replace(row, method=label))
        for method, sequence in seen_in_training(run.protocol, run.scores):
            seen.add((labels[method, sequence], sequence))
    scores = [row for by_label in by_method.values() for rows in by_label.values() for row in rows]
    return Group(runs, scores, seen)


def _labels(runs: list[Run]) -> list[dict[tuple[str, str], str]]:
    """What to call each method and sequence of each run: methods whose settings differ say by what.

    What several runs have alike is told apart by their folders, but for the first of them.
    """
    taken: set[tuple[str, str]] = set()
    result = []
    for run, folder in zip(runs, _distinct_folders(runs), strict=True):
        labels = {}
        for (method, sequence), settings in run.settings.items():
            variants = [v for other in runs for (name, _), v in other.settings.items() if name == method]
            labels[method, sequence] = method + _variation(settings, variants)
        again = {label for (_, sequence), label in labels.items() if (label, sequence) in taken}
        labels = {key: f"{label} ({folder})" if label in again else label for key, label in labels.items()}
        taken |= {(label, sequence) for (_, sequence), label in labels.items()}
        result.append(labels)
    return result


def _distinct_folders(runs: list[Run]) -> list[str]:
    """The shortest ends of the runs' paths that tell all of them apart."""
    paths = [run.folder.resolve().parts for run in runs]
    length = next(n for n in itertools.count(1) if len({path[-n:] for path in paths}) == len(set(paths)))
    return ["/".join(path[-length:]) for path in paths]


def _variation(settings: Settings, variants: list[Settings]) -> str:
    """Those settings that differ between the variants, in brackets, by the last words of their names where these do.

    A part is called by its class, as in "weight=Huber". The sensor's projection belongs to the data. Variants of which
    nothing is known, as of another tool's trajectories, differ in nothing.
    """
    known = dict.fromkeys(key for variant in variants for key in variant if "projection" not in key.split("."))
    keys = [key for key in known if len({repr(variant.get(key)) for variant in variants if variant}) > 1]
    names = {key: key.removesuffix("._target_") for key in keys}
    last = [name.rpartition(".")[2] for name in names.values()]
    shown = {key: short if last.count(short) == 1 else names[key] for key, short in zip(keys, last, strict=True)}
    values = [f"{shown[key]}={_value(key, settings[key])}" for key in keys if key in settings]
    return f" [{', '.join(values)}]" if values else ""


def _value(key: str, value: object) -> str:
    if key in _DIGESTS:
        return str(value)[:8]
    return str(value).rpartition(".")[2] if key.endswith("._target_") else str(value)


def _flat(settings: Any, prefix: str = "") -> Settings:
    if not isinstance(settings, dict):
        return {prefix: settings}
    flat: Settings = {}
    for key, value in settings.items():
        flat |= _flat(value, f"{prefix}.{key}" if prefix else str(key))
    return flat


def _score(row: Mapping[str, Any]) -> Score:
    lengths = {int(length): SegmentAverage(**value) for length, value in row["by_segment_length"].items()}
    return Score(**{**row, "by_segment_length": lengths})
