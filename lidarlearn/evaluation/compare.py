"""Results of several runs side by side: what was measured under the same protocol in one table, the rest apart."""

import json
from collections.abc import Iterable, Mapping
from collections.abc import Sequence as Series
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from lidarlearn.errors import UserError
from lidarlearn.evaluation.layout import TableLayout
from lidarlearn.evaluation.report import report_tables, results_content, sequences_trained_on
from lidarlearn.evaluation.run import Export
from lidarlearn.evaluation.score import Score
from lidarlearn.evaluation.tables import Table
from lidarlearn.metrics.kitti import SegmentAverage

# Two results are comparable where these agree, and the scans of the sequences that they share.
_PROTOCOL = ("beam_correction_deg", "deskew", "max_frames")

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
    scores: Series[Score]
    settings: Mapping[tuple[str, str], Settings]
    layout: TableLayout | None = None


@dataclass(frozen=True)
class Group:
    """Runs that are comparable, as one table.

    Args:
        runs: in the order given.
        scores: all rows; where the same method was run with different settings, its name says which.
    """

    runs: Series[Run]
    scores: Series[Score]

    @property
    def title(self) -> str:
        """Data and protocol in a line."""
        protocol = self.runs[0].protocol
        data = ", ".join(dict.fromkeys(str(run.protocol.get("data")) for run in self.runs))
        return f"{data}: " + ", ".join(f"{key} {json.dumps(protocol.get(key))}" for key in _PROTOCOL)

    def tables(self, layout: TableLayout | None = None) -> list[Table]:
        """The same tables as of a single evaluation."""
        trained_on: dict[str, list[str]] = {}
        for run in self.runs:
            for network, names in sequences_trained_on(run.protocol).items():
                trained_on.setdefault(network, []).extend(names)
        return report_tables(str(self.runs[0].protocol.get("data", "")), self.scores, trained_on, layout)


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
    mine, theirs = a.protocol.get("scans", {}), b.protocol.get("scans", {})
    other = [name for name in mine if name in theirs and mine[name] != theirs[name]]
    if other and not found:
        found.append(f"the scans of sequence {', '.join(other)} are not the same")
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
    return [Group(group, _labelled(group)) for group in groups]


def comparison(groups: Series[Group]) -> tuple[dict[str, Any], list[Table], str]:
    """What to write and print about groups of runs: content of `results.json`, tables, and a last section.

    Where all runs are of one experiment, its table comes first, with the rows of all of them.
    """
    content = {
        "compared": [
            {"runs": [{"folder": run.folder, "protocol": run.protocol} for run in group.runs],
             **results_content(group.scores)}
            for group in groups
        ]
    }  # fmt: skip
    everything = Group([run for g in groups for run in g.runs], [row for g in groups for row in g.scores])
    layouts = [run.layout for run in everything.runs]
    layout = layouts[0] if all(other == layouts[0] for other in layouts) else None
    tables = [] if layout is None else everything.tables(layout)[:1]
    for i, group in enumerate(groups):
        heading = "" if len(groups) == 1 else f" ({i + 1} of {len(groups)}: {group.title})"
        tables += [replace(table, title=table.title + heading) for table in group.tables()]
    return content, tables, _closing(groups)


def _closing(groups: Series[Group]) -> str:
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


def _labelled(runs: Series[Run]) -> list[Score]:
    """All rows, sequence by sequence within each method; methods whose settings differ say by what."""
    rows = [(run, row) for run in runs for row in run.scores]
    result: dict[tuple[str, str], Score] = {}
    for method in dict.fromkeys(row.method for _, row in rows):
        own = [(run, row) for run, row in rows if row.method == method]
        variants = [run.settings[method, row.sequence] for run, row in own]
        for (run, row), settings in zip(own, variants, strict=True):
            label = method + _variation(settings, variants)
            if (label, row.sequence) in result:
                label += f" ({run.folder.name})"
            result[label, row.sequence] = replace(row, method=label)
    by_method = dict.fromkeys(label for label, _ in result)
    return [score for label in by_method for (other, _), score in result.items() if other == label]


def _variation(settings: Settings, variants: Series[Settings]) -> str:
    """Those settings that differ between the variants, in brackets, by the last words of their names where these do.

    A part is called by its class, as in "weight=Huber". The sensor's projection belongs to the data.
    """
    known = dict.fromkeys(key for variant in variants for key in variant if "projection" not in key.split("."))
    keys = [key for key in known if len({repr(variant.get(key)) for variant in variants}) > 1]
    names = {key: key.removesuffix("._target_") for key in keys}
    last = [name.rpartition(".")[2] for name in names.values()]
    shown = {key: short if last.count(short) == 1 else names[key] for key, short in zip(keys, last, strict=True)}
    values = [f"{shown[key]}={_value(key, settings[key])}" for key in keys if key in settings]
    return f" [{', '.join(values)}]" if values else ""


def _value(key: str, value: object) -> str:
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
