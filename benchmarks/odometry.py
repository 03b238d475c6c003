"""Speed and accuracy of the frame-to-model odometries, KISS-ICP and small_gicp on the same scans.

`python -m benchmarks.odometry [--quick] [--kitti FOLDER] [--json FILE]`, after `pip install kiss-icp small_gicp`. All
methods run in turns in this process, with the scans in memory: everything except reading files is measured. Without
--kitti, only the simulated drive is run.
"""

import statistics
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import torch
from hydra import compose, initialize_config_dir
from rich.progress import track
from torch import Tensor

from benchmarks import report
from benchmarks.report import column
from lidarlearn.commands.configs import config_directory
from lidarlearn.commands.data import compose_data_set
from lidarlearn.commands.evaluate import build_odometry, configured_method
from lidarlearn.data.sequence import Sequence
from lidarlearn.errors import UserError
from lidarlearn.metrics.absolute import ape_rmse
from lidarlearn.metrics.relative import relative_errors
from lidarlearn.simulation.drive import Drive
from lidarlearn.simulation.sensors import hdl64

_LARGEST_RPE_CM = 3.0
BASELINES = ("kiss_icp", "small_gicp")
METHODS = ("cv+kd_f2m", "cv+vh_f2m", "cv+p_f2m")
Runner = Callable[[list[Tensor]], Tensor]  # scans to poses T_world_lidar


@dataclass(frozen=True)
class Row:
    """Errors and speed of one method on one drive."""

    drive: str = column("drive")
    method: str = column("method")
    scans_per_second: float = column("scans/s")
    ratio_to_kiss_icp: float = column("of KISS-ICP's")
    ape_rmse_m: float | None = column("APE RMSE [m]")
    mean_rpe_cm: float = column("mean RPE [cm]")
    gpu_memory_mib: float | None = column("GPU memory [MiB]")


def runner(method: str, device: torch.device) -> Runner:
    """A function that runs a method as `evaluate.py` builds it."""
    with initialize_config_dir(str(config_directory()), version_base="1.3"):
        config = compose("evaluate", ["projection@data.projection=hdl64", f"device={device}"])

    def run(scans: list[Tensor]) -> Tensor:
        odometry = build_odometry(config, configured_method(config, method))
        return torch.stack([odometry.register_scan(points).T_world_lidar for points in scans])

    return run


def drives(kitti: Path | None, scans: int) -> dict[str, tuple[list[Tensor], Tensor]]:
    """Scans and true poses of a simulated drive and, if its folder is given, of KITTI 04."""
    found: dict[str, Sequence] = {
        "simulated, static": Drive("urban", seed=1, frames=scans, speed=12.0, static=True, sensor=hdl64())
    }
    if kitti is not None:
        overrides = ["data=kitti_00-08", f"data.root={kitti}", f"data.max_frames={scans}", "data.train_sequences=[]"]
        found["KITTI 04"] = compose_data_set(overrides).sequence("04")
    return {name: _scans_and_truth(name, sequence) for name, sequence in found.items()}


def _scans_and_truth(name: str, sequence: Sequence) -> tuple[list[Tensor], Tensor]:
    if sequence.T_world_lidar is None:
        raise UserError(f"{name}: no ground truth\n  change: add its poses to the folder of --kitti, or omit --kitti")
    return [scan.points for scan in track(sequence, f"reading {name}", len(sequence))], sequence.T_world_lidar


def measure(options: report.Options) -> list[Row]:
    """Measure every method on every drive; speeds are medians over the rounds."""
    scans, rounds = (8, 1) if options.quick else (50, 5)
    runners = {method: runner(method, options.device) for method in (*BASELINES, *METHODS)}
    rows = []
    for name, (points, true) in drives(options.kitti, scans).items():
        seconds: dict[str, list[float]] = {method: [] for method in runners}
        memory: dict[str, float | None] = dict.fromkeys(runners)
        poses = {}
        for _ in track(range(rounds), name):
            for method, run in runners.items():
                if options.device.type == "cuda":
                    torch.cuda.reset_peak_memory_stats()
                start = time.perf_counter()
                poses[method] = run(points)
                seconds[method].append(time.perf_counter() - start)
                if options.device.type == "cuda" and method in METHODS:
                    memory[method] = torch.cuda.max_memory_allocated() / 2**20
        for method in runners:
            pace = statistics.median(k / s for k, s in zip(seconds["kiss_icp"], seconds[method], strict=True))
            rpe_cm = 100 * float(relative_errors(poses[method], true).translation.mean())
            per_second = len(points) / statistics.median(seconds[method])
            rows.append(Row(name, method, per_second, pace, ape_rmse(poses[method], true), rpe_cm, memory[method]))
    wrong = [f"{r.method} on {r.drive}" for r in rows if r.method in METHODS and not r.mean_rpe_cm < _LARGEST_RPE_CM]
    if wrong:
        raise report.BenchmarkError(f"mean RPE of {_LARGEST_RPE_CM} cm or more: {', '.join(wrong)}", rows)
    return rows


if __name__ == "__main__":
    report.main(__doc__, odometry=measure)
