"""The share of loading, projection and loss in a training, compared with bare steps of the network.

Three kinds of steps are timed in turns: the steps of `train.py`, fed from the vertex-map cache (on a GPU with resident
maps, a compiled loss and `trainer.precision=bf16-mixed`); the same steps on batches in memory; and bare steps, which
are the forward and backward pass of the network with a trivial loss and the step of the optimizer.
"""

import statistics
import tempfile
import time
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager
from dataclasses import dataclass

import torch
from hydra import compose, initialize_config_dir
from hydra.utils import instantiate
from lightning.fabric.utilities import move_data_to_device

from benchmarks import report
from benchmarks.report import column
from lidarlearn.commands.configs import config_directory
from lidarlearn.commands.train import build_module
from lidarlearn.data.datamodule import OdometryDataModule
from lidarlearn.data.pairs import Pair

_STEPS, _ROUNDS = 12, 5


@dataclass(frozen=True)
class Row:
    """Pairs per second from the cache, also relative to the other kinds of steps."""

    image: str = column("image")
    batch: int = column("batch")
    device: str = column("device")
    pairs_per_second: float = column("from the cache [pairs/s]")
    ratio_to_memory: float = column("of in memory")
    ratio_to_bare_network: float = column("of the bare network's")


def measure(options: report.Options) -> list[Row]:
    """Measure the default network for simulated drives and the paper's, on scans of a simulated town."""
    frames = 60 if options.quick else 220
    on_gpu = options.device.type == "cuda"
    sizes = ((32, 360, 1024), (64, 720, 512)) if on_gpu else ((32, 360, 16), (64, 720, 8))
    with tempfile.TemporaryDirectory() as folder:
        return [_measure(options, folder, frames, *size) for size in (sizes[:1] if options.quick else sizes)]


def _measure(options: report.Options, folder: str, frames: int, height: int, width: int, batch_size: int) -> Row:
    overrides = [f"data.root={folder}", "data.train_sequences=[urban_00,urban_01,urban_02]", "data.val_sequences=[]"]
    overrides += [f"datamodule.cache_root={folder}/cache", "data.test_sequences=[]", f"data.frames={frames}"]
    overrides += [f"datamodule.height={height}", f"datamodule.width={width}", f"datamodule.batch_size={batch_size}"]
    with initialize_config_dir(str(config_directory()), version_base="1.3"):
        config = compose("train", ["scheduler=constant", *overrides, "run_dir=/nowhere"])
    datamodule: OdometryDataModule = instantiate(config.datamodule)
    datamodule.prepare_data()
    datamodule.setup()
    datamodule.keep_maps_on(options.device)
    module = build_module(config, datamodule, "benchmark").to(options.device).train()
    optimizer = module.configure_optimizers()["optimizer"]

    def autocast() -> AbstractContextManager[None]:
        return torch.autocast(options.device.type, torch.bfloat16, enabled=options.device.type == "cuda")

    def batches() -> Iterator[Pair]:
        while True:
            yield from datamodule.train_dataloader()

    def to_device(batch: Pair) -> Pair:
        moved = move_data_to_device(batch, options.device)
        return datamodule.completed(moved, augmented=True)

    def step(batch: Pair, bare: bool = False) -> None:
        optimizer.zero_grad()
        with autocast():
            parameters = module(batch["reference"], batch["target"])
        loss = parameters.square().sum() if bare else module.compute_loss(parameters, batch).loss
        loss.backward()
        optimizer.step()

    stream = batches()
    resident = [to_device(next(stream)) for _ in range(_STEPS)]
    kinds: dict[str, Callable[[int], None]] = {
        "cache": lambda _: step(to_device(next(stream))),
        "memory": lambda i: step(resident[i]),
        "bare": lambda i: step(resident[i], bare=True),
    }
    seconds: dict[str, list[float]] = {kind: [] for kind in kinds}
    for i in range(3):
        step(resident[i])
    for _ in range(1 if options.quick else _ROUNDS):
        for kind, run in kinds.items():
            start = time.perf_counter()
            for i in range(_STEPS):
                run(i)
            if options.device.type == "cuda":
                torch.cuda.synchronize()
            seconds[kind].append(time.perf_counter() - start)

    def pace_of(kind: str) -> float:
        return statistics.median(k / c for c, k in zip(seconds["cache"], seconds[kind], strict=True))

    pairs_per_second = _STEPS * batch_size / statistics.median(seconds["cache"])
    image = f"{height}x{width}"
    return Row(image, batch_size, str(options.device), pairs_per_second, pace_of("memory"), pace_of("bare"))


if __name__ == "__main__":
    report.main(__doc__, training=measure)
