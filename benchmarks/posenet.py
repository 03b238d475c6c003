"""The speed of PoseNet: scan by scan, as `evaluate.py` runs it, and in batches of vertex maps."""

import statistics
import time
from collections.abc import Callable
from dataclasses import dataclass

import torch

from benchmarks import report
from benchmarks.report import column
from lidarlearn.commands.data import compose_data_set
from lidarlearn.models.posenet import PoseNet
from lidarlearn.odometry.initialization.posenet import PoseNetInitialization
from lidarlearn.odometry.initialization_only import InitializationOnly
from lidarlearn.simulation.drive import Drive
from lidarlearn.simulation.sensors import hdl64
from lidarlearn.training.trained_network import TrainedNetwork

_ROUNDS = 5


@dataclass(frozen=True)
class Row:
    """Motions per second of a ResNet-18 for one size of images."""

    work: str = column("work")
    image: str = column("image")
    device: str = column("device")
    per_second: float = column("motions/s")


def measure(options: report.Options) -> list[Row]:
    """Measure a network with random weights, which is as fast as a trained one."""
    drive = Drive("urban", frames=4 if options.quick else 20, sensor=hdl64())
    scans = [scan.points for scan in drive]
    projection = compose_data_set(["data=simulated_urban"]).projection
    model = PoseNet().to(options.device).eval()
    network = TrainedNetwork(model, projection, options.device)
    image = f"{projection.height}x{projection.width}"
    maps = torch.stack([projection.vertex_map(points) for points in scans]).to(options.device)
    pairs = 512 if options.device.type == "cuda" else 8
    reference = maps[torch.arange(pairs) % len(maps)]
    target = maps[(torch.arange(pairs) + 1) % len(maps)]

    def scan_by_scan() -> int:
        odometry = InitializationOnly(PoseNetInitialization(network), options.device)
        for points in scans:
            odometry.register_scan(points)
        return len(scans)

    def batched() -> int:
        network.relative_pose(reference, target)
        return pairs

    return [
        Row("scan by scan, from points", image, str(options.device), _per_second(scan_by_scan, options)),
        Row(f"batches of {pairs} pairs, from vertex maps", image, str(options.device), _per_second(batched, options)),
    ]


def _per_second(work: Callable[[], int], options: report.Options) -> float:
    rates = []
    work()
    for _ in range(1 if options.quick else _ROUNDS):
        start = time.perf_counter()
        done = work()
        if options.device.type == "cuda":
            torch.cuda.synchronize()
        rates.append(done / (time.perf_counter() - start))
    return statistics.median(rates)


if __name__ == "__main__":
    report.main(__doc__, posenet=measure)
