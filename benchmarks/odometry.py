"""Speed and accuracy of the frame-to-model odometries beside KISS-ICP's and small_gicp's, on the same scans.

`python -m benchmarks.odometry [--quick] [--kitti FOLDER] [--json FILE]`, after `pip install kiss-icp small_gicp`. All
run in turns, scan by scan in this process, with the scans in memory: files apart, everything counts. Without --kitti
only the simulated drive is run; --quick looks whether all run on a few scans and ours are accurate, not at time.
"""

import argparse
import json
import platform
import statistics
import sys
import time
from collections.abc import Callable
from dataclasses import asdict, dataclass
from importlib.metadata import version
from pathlib import Path

import torch
from hydra import compose, initialize_config_dir
from rich.console import Console
from rich.progress import track
from rich.table import Table
from torch import Tensor

from lidarlearn.commands.configs import config_directory
from lidarlearn.commands.data import compose_data_set
from lidarlearn.commands.evaluate import build_odometry
from lidarlearn.evaluation.methods import BASELINES, parse_method
from lidarlearn.metrics.absolute import ape_rmse
from lidarlearn.metrics.relative import relative_errors
from lidarlearn.simulation.drive import Drive
from lidarlearn.simulation.sensors import hdl64

_LARGEST_RPE_CM = 3.0
METHODS = ("cv+kd_f2m", "cv+vh_f2m", "cv+p_f2m")
Runner = Callable[[list[Tensor]], Tensor]  # scans to poses T_world_lidar


@dataclass(frozen=True)
class Row:
    """What one method did on one drive: errors, and scans per second also as a share of KISS-ICP's."""

    drive: str
    method: str
    scans_per_second: float
    ratio_to_kiss_icp: float
    ape_rmse_m: float
    mean_rpe_cm: float


def runner(method: str, device: str) -> Runner:
    """A method as `evaluate.py` builds it."""
    with initialize_config_dir(str(config_directory()), version_base="1.3"):
        config = compose("evaluate", ["projection@data.projection=hdl64", f"device={device}"])

    def run(scans: list[Tensor]) -> Tensor:
        odometry = build_odometry(config, parse_method(method))
        return torch.stack([odometry.register_scan(points).T_world_lidar for points in scans])

    return run


def drives(kitti: Path | None, scans: int) -> dict[str, tuple[list[Tensor], Tensor]]:
    """Scans and true poses of a simulated drive and, given its folder, of KITTI 04."""
    simulated = Drive("urban", seed=1, frames=scans, speed=12.0, static=True, sensor=hdl64())
    found = {"simulated, static": ([s.points for s in track(simulated, "simulating")], simulated.T_world_lidar)}
    if kitti is not None:
        overrides = ["data=kitti_00-08", f"data.root={kitti}", f"data.max_frames={scans}", "data.train_sequences=[]"]
        sequence = compose_data_set(overrides).sequence("04")
        found["KITTI 04"] = ([s.points for s in sequence], sequence.T_world_lidar)
    return found  # type: ignore[return-value]


def main() -> None:
    """Run everything, print the table and, where asked for, write it as JSON."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--kitti", type=Path, help="folder of KITTI odometry with sequence 04")
    parser.add_argument("--json", type=Path, help="file to write the table to")
    parser.add_argument("--quick", action="store_true", help="a few scans, once: for correctness, not for time")
    parser.add_argument("--device", default="cuda" if torch.cuda.is_available() else "cpu", help="of our methods")
    options = parser.parse_args()
    scans, rounds = (8, 1) if options.quick else (50, 5)
    runners = {method: runner(method, options.device) for method in (*BASELINES, *METHODS)}
    rows = []
    for name, (points, true) in drives(options.kitti, scans).items():
        seconds: dict[str, list[float]] = {method: [] for method in runners}
        poses = {}
        for _ in track(range(rounds), name):
            for method, run in runners.items():
                start = time.perf_counter()
                poses[method] = run(points)
                seconds[method].append(time.perf_counter() - start)
        for method in runners:
            pace = statistics.median(k / s for k, s in zip(seconds["kiss_icp"], seconds[method], strict=True))
            rpe_cm = 100 * float(relative_errors(poses[method], true).translation.mean())
            per_second = len(points) / statistics.median(seconds[method])
            rows.append(Row(name, method, per_second, pace, float(ape_rmse(poses[method], true)), rpe_cm))
    show(rows)
    if options.json is not None:
        about = {"platform": platform.platform(), "threads": torch.get_num_threads(), "device": options.device}
        about |= {package: version(package) for package in ("torch", "kiss-icp", "small-gicp")}
        options.json.write_text(json.dumps({"about": about, "rows": [asdict(row) for row in rows]}, indent=2))
    wrong = [row for row in rows if row.method in METHODS and not row.mean_rpe_cm < _LARGEST_RPE_CM]
    if wrong:
        sys.exit(
            f"error: mean RPE of {_LARGEST_RPE_CM} cm or more: {', '.join(f'{r.method} on {r.drive}' for r in wrong)}"
        )


def show(rows: list[Row]) -> None:
    """The rows as a table."""
    table = Table(title="frame-to-model odometries, files apart")
    for heading in ("drive", "method"):
        table.add_column(heading, no_wrap=True)
    for heading in ("scans/s", "ratio", "APE [m]", "RPE [cm]"):
        table.add_column(heading, justify="right")
    for row in rows:
        numbers = (f"{row.scans_per_second:.1f}", f"{row.ratio_to_kiss_icp:.2f}")
        table.add_row(row.drive, row.method, *numbers, f"{row.ape_rmse_m:.3f}", f"{row.mean_rpe_cm:.2f}")
    Console().print(table)
    print("ratio: of scans/s to KISS-ICP's. APE: RMSE after alignment. RPE: mean over consecutive scans.")


if __name__ == "__main__":
    main()
