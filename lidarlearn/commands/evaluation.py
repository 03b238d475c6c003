"""`python -m lidarlearn.evaluation compare|map|convergence ...`: comparisons, maps and basins of convergence."""

import argparse
import json
import sys
from dataclasses import asdict
from pathlib import Path

from hydra.utils import instantiate
from omegaconf import DictConfig

from lidarlearn.commands import entry_point
from lidarlearn.commands.compare import compare
from lidarlearn.commands.device import resolve_device
from lidarlearn.commands.maps import make_maps
from lidarlearn.commands.run_folder import held_run_folder, write_run_description
from lidarlearn.data.sequence import DataSet
from lidarlearn.errors import UserError
from lidarlearn.evaluation.convergence import basin_figure, basin_tables, convergence_basin
from lidarlearn.evaluation.maps import MapSettings
from lidarlearn.evaluation.report import print_tables
from lidarlearn.progress import progress

_USAGE = """usage:
  python -m lidarlearn.evaluation compare RUN RUN ... [--output DIR]
      results of several run folders side by side, one table for each protocol
  python -m lidarlearn.evaluation map RUN [--method NAME] [--sequence NAME] [--voxel 0.2] [--every 1]
                                          [--min-range 2.5] [--max-range 60] [data.root=DIR]
      maps of the drives of a run as point clouds (.ply) and pictures, and their sharpness, into RUN/maps
  python -m lidarlearn.evaluation convergence [data=...] [backends=[p_f2m,kd_f2m]] [KEY=VALUE ...]
      how far off an initial pose may be for a registration to succeed"""


def main() -> None:
    """Run one of the commands."""
    command = sys.argv[1] if len(sys.argv) > 1 else ""
    if command == "compare":
        _compare(sys.argv[2:])
    elif command == "map":
        _map(sys.argv[2:])
    elif command == "convergence":
        del sys.argv[1]
        entry_point.run(measure_convergence, "convergence")
    else:
        print(_USAGE)
        sys.exit(2)


def measure_convergence(config: DictConfig) -> None:
    """Measure, print and draw the basins of convergence of the configured backends on the test sequences.

    Args:
        config: composed from `configs/convergence.yaml`.

    Raises:
        UserError: the data or a setting is invalid.
    """
    resolve_device(config)
    unknown = [name for name in config.backends if name not in config.odometry]
    if unknown or not config.backends:
        raise UserError(f"backends={unknown}: choose among {', '.join(config.odometry)}")
    with held_run_folder(Path(config.run_dir)) as folder:
        _measure_convergence(config, folder)


def _measure_convergence(config: DictConfig, folder: Path) -> None:
    data: DataSet = instantiate(config.data)
    data.prepare(data.test_sequences)
    sequences = list(data.sequences(data.test_sequences).values())
    if len(sequences) != 1:
        raise UserError(f"data.test_sequences={list(data.test_sequences)}: one sequence is measured at a time")
    sequence, probe = sequences[0], instantiate(config.probe)
    write_run_description(folder, config)
    basins = {}
    for name in config.backends:
        backend = instantiate(config.odometry[name])
        with progress(f"{name} on {sequence.name}", len(sequence)) as advance:
            basins[name] = convergence_basin(backend, sequence, probe, config.device, advance)
    measured = json.dumps({name: asdict(basin) for name, basin in basins.items()}, indent=2)
    (folder / "convergence.json").write_text(measured + "\n", encoding="utf-8")
    print_tables(basin_tables(basins))
    basin_figure(f"sequence {sequence.name}", basins).savefig(folder / "convergence.png")
    print(f"results: {folder / 'convergence.json'}  plot: {folder / 'convergence.png'}")


def _compare(arguments: list[str]) -> None:
    parser = argparse.ArgumentParser("python -m lidarlearn.evaluation compare")
    parser.add_argument("runs", nargs="+", type=Path, metavar="RUN", help="folder of an evaluation")
    parser.add_argument("--output", type=Path, metavar="DIR", help="where to write results.json and results.md")
    options = parser.parse_args(arguments)
    with entry_point.readable_errors("evaluate"):
        compare(options.runs, options.output)


def _map(arguments: list[str]) -> None:
    default = MapSettings()
    parser = argparse.ArgumentParser("python -m lidarlearn.evaluation map")
    parser.add_argument("run", type=Path, metavar="RUN", help="folder of an evaluation")
    parser.add_argument("--method", metavar="NAME", help="only this method, e.g. cv+kd_f2m; default: all")
    parser.add_argument("--sequence", metavar="NAME", help="only this sequence; default: all")
    parser.add_argument("--voxel", type=float, default=default.voxel_size_m, metavar="M", help="edge of a voxel [m]")
    parser.add_argument("--every", type=int, default=default.every, metavar="N", help="only every n-th scan")
    parser.add_argument("--min-range", type=float, default=default.min_range_m, metavar="M", help="least range [m]")
    parser.add_argument("--max-range", type=float, default=default.max_range_m, metavar="M", help="greatest range [m]")
    parser.add_argument("overrides", nargs="*", metavar="data.KEY=VALUE", help="if the data has moved: data.root=DIR")
    options = parser.parse_intermixed_args(arguments)

    with entry_point.readable_errors("evaluate", options.overrides):
        settings = MapSettings(options.voxel, options.every, options.min_range, options.max_range)
        make_maps(options.run, options.method, options.sequence, settings, options.overrides)
