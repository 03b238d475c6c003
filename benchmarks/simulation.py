"""What a simulated scan costs, compared with bare ray casting of as many rays."""

import os
import tempfile
import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np

from lidarlearn.simulation.drive import Drive
from lidarlearn.simulation.raycasting import RayCaster
from lidarlearn.simulation.sensors import hdl64

_SCANS = 50


def cpu_and_wall_ms(work: Callable[[int], object]) -> tuple[float, float]:
    """Processor and wall time of one call [ms], mean over `_SCANS` calls, in as many threads as make a data set."""
    with ThreadPoolExecutor(min(os.cpu_count() or 1, 8)) as pool:
        wall, cpu = time.perf_counter(), time.process_time()
        list(pool.map(work, range(_SCANS)))
        return 1e3 * (time.process_time() - cpu) / _SCANS, 1e3 * (time.perf_counter() - wall) / _SCANS


def main() -> None:
    """Print a table."""
    drive = Drive("urban", frames=_SCANS, sensor=hdl64(2000))
    caster = RayCaster(drive.world.static)
    pose = drive.trajectory.at(np.zeros(1))
    directions = drive.sensor.directions(0, pose[:, :3, :3])
    origins = np.broadcast_to(pose[:, :3, 3].astype(np.float32), directions.shape)
    rays = np.concatenate([origins, directions], axis=-1).reshape(-1, 6)
    drive.ranges(0)
    caster.cast(rays)
    with tempfile.TemporaryDirectory() as folder:
        rows = {
            "bare ray casting": cpu_and_wall_ms(lambda _: caster.cast(rays)),
            "scan (motion, movers, noise, drop-out, writing)": cpu_and_wall_ms(
                lambda i: np.save(Path(folder) / f"{i}.npy", drive.ranges(i))
            ),
        }
    print(f"{len(rays)} rays, {len(drive.world.static.triangles)} triangles, {len(drive.world.movers)} movers")
    for name, (cpu, wall) in rows.items():
        print(f"{name:50s} {cpu:6.1f} ms processor {wall:6.1f} ms wall")
    bare, scan = rows.values()
    print(f"ratio {scan[0] / bare[0]:.2f} processor, {scan[1] / bare[1]:.2f} wall")


if __name__ == "__main__":
    main()
