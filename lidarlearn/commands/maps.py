"""`python -m lidarlearn.evaluation map`: maps from the trajectories of an evaluation and the scans."""

import json
from collections.abc import Collection
from dataclasses import asdict
from pathlib import Path
from typing import Any, cast

from hydra.utils import instantiate
from omegaconf import DictConfig, OmegaConf

from lidarlearn.data.sequence import DataSet, Sequence
from lidarlearn.data.writable import atomic_write
from lidarlearn.errors import UserError
from lidarlearn.evaluation.map_figure import map_figure
from lidarlearn.evaluation.maps import MapSettings, build_map
from lidarlearn.evaluation.report import print_tables
from lidarlearn.evaluation.run import Export, read_export
from lidarlearn.evaluation.tables import Table
from lidarlearn.progress import progress
from lidarlearn.training.parts import require_trusted


def make_maps(
    run: Path, method: str | None, sequence: str | None, settings: MapSettings, overrides: Collection[str] = ()
) -> None:
    """Write a map and a picture for each method and sequence of a run, and `maps.json`; print a table of the maps.

    Args:
        run: run folder of an evaluation.
        method: name of the only method; None takes all.
        sequence: name of the only sequence; None takes all.
        settings: settings of the maps.
        overrides: `data.KEY=VALUE`, if the data set has moved since.

    Raises:
        UserError: the run has no such trajectory, or its scans are missing or have changed.
    """
    config = _config_of(run, overrides)
    exports = _chosen(run, method, sequence)
    data: DataSet = instantiate(config.data)
    names = sorted({export.sequence for export in exports})
    data.prepare(names)
    sequences = data.sequences(names)
    _entries(run / "maps" / "maps.json")  # reports a damaged file before the work
    rows = []
    for export in exports:
        rows.append(_make_map(run, export, sequences[export.sequence], settings, config.data.deskew))
        _add_entry(run / "maps" / "maps.json", rows[-1])
    print_tables([_table(rows)])
    print(f"maps: {run / 'maps'}")


def _config_of(run: Path, overrides: Collection[str]) -> DictConfig:
    """The configuration of the run, with the overrides applied to its data set."""
    path = run / "config.yaml"
    if not path.is_file() or not (run / "trajectories").is_dir():
        raise UserError(
            f"{run.absolute()}: no config.yaml, or no trajectories\n"
            "  change: name a run folder of evaluate.py with methods (not one of trajectories=DIR or -m)"
        )
    config = OmegaConf.load(path)
    assert isinstance(config, DictConfig)
    if foreign := [override for override in overrides if not (override.startswith("data.") and "=" in override)]:
        raise UserError(f"{' '.join(foreign)}: only settings of the data set can change\n  change: data.KEY=VALUE")
    OmegaConf.set_struct(config, True)
    config.merge_with_dotlist(list(overrides))
    require_trusted(cast("dict[str, Any]", OmegaConf.to_container(config.data, resolve=True)), DataSet)
    return config


def _chosen(run: Path, method: str | None, sequence: str | None) -> list[Export]:
    """The finished trajectories of the chosen method and sequence."""
    exports = [Export(path.parent, path.stem) for path in sorted((run / "trajectories").glob("*/*.txt"))]
    interrupted = [export for export in exports if export.sequence.endswith(".partial")]
    found = [export for export in exports if export not in interrupted and export.settings() is not None]
    chosen = [e for e in found if method in (None, e.folder.name) and sequence in (None, e.sequence)]
    if not chosen:
        there = [f"{export.folder.name} on {export.sequence}" for export in found]
        there += [f"{export.kitti.relative_to(run)} (interrupted)" for export in interrupted]
        raise UserError(
            f"{run.absolute()}: no finished trajectory of {method or 'any method'} on {sequence or 'any sequence'}; "
            f"found: {', '.join(there) or 'nothing'}\n"
            f"  change: --method, --sequence, or finish the run: evaluate.py hydra.run.dir={run}"
        )
    return chosen


def _make_map(run: Path, export: Export, sequence: Sequence, settings: MapSettings, deskewed: bool) -> dict[str, Any]:
    """Build and write one map; return its entry in `maps.json`."""
    method = export.folder.name
    scans = (export.settings() or {}).get("scans")
    if scans not in (None, sequence.fingerprint):
        raise UserError(
            f"{sequence.name}: these are not the scans of the run (files or settings of the data have changed)\n"
            "  change: data.root=DIR, or run evaluate.py again"
        )
    T_world_lidar, _ = read_export(export, sequence)
    used = range(0, len(sequence), settings.every)
    with progress(f"map of {method} on {sequence.name}", len(used)) as advance:
        built = build_map(sequence, T_world_lidar, settings, deskewed, advance)
    path = run / "maps" / method / f"{sequence.name}.ply"
    built.write(path)
    figure = map_figure(
        f"sequence {sequence.name}",
        built.points,
        settings.voxel_size_m,
        {method: T_world_lidar},
        sequence.T_world_lidar,
    )
    figure.savefig(path.with_name(f"{sequence.name}.png"))
    return {
        "method": method,
        "sequence": sequence.name,
        "points": len(built.points),
        "extent_m": built.extent_m,
        "file_bytes": path.stat().st_size,
        "mean_plane_variance_m2": built.mean_plane_variance_m2,
        "settings": asdict(settings),
    }


def _add_entry(path: Path, row: dict[str, Any]) -> None:
    """Add the entry of a map to `maps.json`, replacing an earlier one of the same method and sequence."""
    others = [old for old in _entries(path) if (old["method"], old["sequence"]) != (row["method"], row["sequence"])]
    with atomic_write(path) as draft:
        draft.write_text(json.dumps({"maps": [*others, row]}, indent=2) + "\n", encoding="utf-8")


def _entries(path: Path) -> list[dict[str, Any]]:
    """The entries of earlier maps; empty if there is no file."""
    if not path.is_file():
        return []
    try:
        return json.loads(path.read_text(encoding="utf-8"))["maps"]
    except (ValueError, KeyError, TypeError) as error:
        raise UserError(
            f"{path.absolute()}: damaged ({error})\n  change: remove it; the maps themselves stay"
        ) from error


def _table(rows: list[dict[str, Any]]) -> Table:
    cells = [
        (
            row["method"],
            row["sequence"],
            f"{row['points']:,}",
            " x ".join(f"{edge:.0f}" for edge in row["extent_m"]),
            f"{row['file_bytes'] / 1e6:.1f}",
            "-" if row["mean_plane_variance_m2"] is None else f"{1e4 * row['mean_plane_variance_m2']:.2f}",
        )
        for row in rows
    ]
    sharpest = frozenset({5} if len({row["sequence"] for row in rows}) == 1 else ())
    return Table(
        "Maps",
        ("method", "sequence", "points", "extent [m]", "file [MB]", "MPV [cm^2]"),
        tuple(cells),
        notes=(
            "MPV: mean plane variance, how thick surfaces came out: the lower, the better the poses fit together. "
            "It compares methods on the same scans, not one sequence with another.",
        ),
        labels=2,
        lowest=sharpest,
    )
