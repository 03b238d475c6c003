"""Results of several runs side by side. Runs share a table if they were measured under the same protocol."""

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

# Two runs are comparable if their protocols agree in these entries...
_PROTOCOL = ("beam_correction_deg", "deskew", "max_frames")
# ...and in these for each common sequence. Results of earlier versions do not describe the ground truth.
_OF_SEQUENCES = {"scans": "scans", "ground_truth": "ground truth"}

_DIGESTS = ("network", "code")  # hashes, of which only the first digits are shown

Settings = dict[str, Any]  # plain values by dotted key


@dataclass(frozen=True)
class Run:
    """The results in an evaluation's run folder.

    Args:
        folder: the run folder.
        protocol: the protocol in `results.json`.
        scores: the rows in `results.json`.
        settings: the settings of each method on each sequence; empty for trajectories of other tools.
        layout: the table of its experiment; None without an experiment.
    """

    folder: Path
    protocol: Mapping[str, Any]
    scores: list[Score]
    settings: Mapping[tuple[str, str], Settings]
    layout: TableLayout | None = None


@dataclass(frozen=True)
class Group:
    """Comparable runs, which share a table.

    Args:
        runs: the runs, in the given order.
        scores: all rows. If a method was run with different settings, its names in the rows state them.
        seen: methods, by these names, and sequences on which their networks were trained.
    """

    runs: list[Run]
    scores: list[Score]
    seen: Set[tuple[str, str]]

    @property
    def title(self) -> str:
        """Data and protocol in one line."""
        protocol = self.runs[0].protocol
        data = ", ".join(dict.fromkeys(str(run.protocol.get("data")) for run in self.runs))
        return f"{data}: " + ", ".join(f"{key} {json.dumps(protocol.get(key))}" for key in _PROTOCOL)

    def tables(self, layout: TableLayout | None = None) -> list[Table]:
        """The same tables as for a single evaluation."""
        return report_tables(str(self.runs[0].protocol.get("data", "")), self.scores, self.seen, layout)


def read_run(folder: Path) -> Run:
    """Read a run folder.

    Raises:
        UserError: the folder holds no results of an evaluation.
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
    """Why two runs are not comparable; empty if they are."""
    found = [
        f"{key}: {json.dumps(a.protocol.get(key))} against {json.dumps(b.protocol.get(key))}"
        for key in _PROTOCOL
        if a.protocol.get(key) != b.protocol.get(key)
    ]
    if found:
        return found  # this also explains any difference below
    for key, what in _OF_SEQUENCES.items():
        mine, theirs = a.protocol.get(key, {}), b.protocol.get(key, {})
        other = [name for name in mine if name in theirs and mine[name] != theirs[name]]
        if other:
            found.append(f"not the same {what} of sequence {', '.join(other)}")
    return found


def comparable_groups(runs: Iterable[Run]) -> list[Group]:
    """Sort runs into groups of comparable runs."""
    groups: list[list[Run]] = []
    for run in runs:
        group = next((g for g in groups if not any(differences(other, run) for other in g)), None)
        if group is None:
            groups.append([run])
        else:
            group.append(run)
    return [_group(runs) for runs in groups]


def comparison(groups: list[Group]) -> tuple[dict[str, Any], list[Table], str]:
    """The report on groups of runs: the content of `results.json`, the tables, and a closing section.

    If all runs belong to one experiment, its table comes first, with the rows of all runs. If two groups measured the
    same method on the same sequence, each group gets such a table instead.
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
        layout = None  # not once more for each group
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
        f"\nNot comparable: {i} and {k}, {'; '.join(why)}."
        for (i, a), (k, b) in itertools.combinations(enumerate(groups, 1), 2)
        if (why := differences(a.runs[0], b.runs[0]))
    ]
    return "\n".join(lines) + "\n"


def _measured_with(run: Run) -> str:
    keys = ("lidarlearn", "git", "torch", "device", "seed")
    return ", ".join(f"{key} {run.protocol[key]}" for key in keys if key in run.protocol)


def _group(runs: list[Run]) -> Group:
    """A group with the rows of all runs, sorted by method, then by the name with its settings."""
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
    """For each run, the names in the table by method and sequence.

    Methods whose settings differ are named with these settings. If several runs measured the same, all but the first
    are named with their folders.
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
    """The shortest endings of the runs' paths that are all different."""
    paths = [run.folder.resolve().parts for run in runs]
    length = next(n for n in itertools.count(1) if len({path[-n:] for path in paths}) == len(set(paths)))
    return ["/".join(path[-length:]) for path in paths]


def _variation(settings: Settings, variants: list[Settings]) -> str:
    """The settings that differ between variants, in brackets, such as " [weight=Huber]"; empty if none differ.

    Keys are shortened to their last words if these are unique, targets to the names of their classes. The projection
    is left out because it belongs to the data. Variants without settings (other tools' trajectories) do not count.
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
