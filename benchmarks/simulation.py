"""The cost of a simulated scan, compared with bare ray casting of the same number of rays."""

import os
import tempfile
import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from benchmarks import report
from benchmarks.report import column
from lidarlearn.simulation.drive import Drive
from lidarlearn.simulation.raycasting import RayCaster
from lidarlearn.simulation.sensors import hdl64


@dataclass(frozen=True)
class Row:
    """Cost per scan, and its ratio to bare ray casting."""

    work: str = column("work")
    rays: int = column("rays")
    processor_ms: float = column("processor [ms]")
    wall_ms: float = column("wall [ms]")
    processor_ratio: float = column("processor ratio")
    wall_ratio: float = column("wall ratio")


def cpu_and_wall_ms(work: Callable[[int], object], scans: int) -> tuple[float, float]:
    """Mean processor and wall time per call [ms], with as many threads as for making a data set."""
    with ThreadPoolExecutor(min(os.cpu_count() or 1, 8)) as pool:
        wall, cpu = time.perf_counter(), time.process_time()
        list(pool.map(work, range(scans)))
        return 1e3 * (time.process_time() - cpu) / scans, 1e3 * (time.perf_counter() - wall) / scans


def measure(options: report.Options) -> list[Row]:
    """Measure a drive through a town with an HDL-64 of 2,000 columns."""
    scans = 10 if options.quick else 50
    drive = Drive("urban", frames=scans, sensor=hdl64(2000))
    caster = RayCaster(drive.world.static)
    pose = drive.trajectory.at(np.zeros(1))
    directions = drive.sensor.directions(0, pose[:, :3, :3])
    origins = np.broadcast_to(pose[:, :3, 3].astype(np.float32), directions.shape)
    rays = np.concatenate([origins, directions], axis=-1).reshape(-1, 6)
    drive.ranges(0)
    caster.cast(rays)
    with tempfile.TemporaryDirectory() as folder:
        times = {
            "bare ray casting": cpu_and_wall_ms(lambda _: caster.cast(rays), scans),
            "scan: motion, movers, noise, drop-out, writing": cpu_and_wall_ms(
                lambda i: np.save(Path(folder) / f"{i}.npy", drive.ranges(i)), scans
            ),
        }
    bare_cpu, bare_wall = times["bare ray casting"]
    return [Row(work, len(rays), cpu, wall, cpu / bare_cpu, wall / bare_wall) for work, (cpu, wall) in times.items()]


if __name__ == "__main__":
    report.main(__doc__, simulation=measure)
