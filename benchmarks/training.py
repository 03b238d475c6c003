"""What loading costs a training: steps fed from the vertex-map cache against the same steps on tensors in memory.

`python -m benchmarks.training [KEY=VALUE ...]` takes the overrides of train.py; both ways are timed in turns.
"""

import statistics
import sys
import time
from collections.abc import Iterable

import torch
from hydra import compose, initialize_config_dir
from hydra.utils import instantiate

from lidarlearn.commands.configs import config_directory
from lidarlearn.commands.train import build_module
from lidarlearn.data.datamodule import OdometryDataModule
from lidarlearn.data.pairs import Pair

_STEPS, _ROUNDS = 12, 5


def main() -> None:
    """Print pairs per second of both ways and their ratio."""
    with initialize_config_dir(str(config_directory()), version_base="1.3"):
        config = compose("train", ["scheduler=constant", *sys.argv[1:], "run_dir=/nowhere"])
    device = torch.device("cuda" if torch.cuda.is_available() and config.device != "cpu" else "cpu")
    datamodule: OdometryDataModule = instantiate(config.datamodule)
    datamodule.prepare_data()
    datamodule.setup()
    module = build_module(config, datamodule, "benchmark").to(device).train()
    optimizer = module.configure_optimizers()["optimizer"]  # type: ignore[index, call-overload]

    def batches() -> Iterable[Pair]:
        while True:
            yield from datamodule.train_dataloader()

    def to_device(batch: Pair) -> Pair:
        moved = {key: value.to(device, non_blocking=True) for key, value in batch.items()}  # type: ignore[attr-defined]
        return datamodule.on_after_batch_transfer(moved, 0)

    def step(batch: Pair) -> None:
        optimizer.zero_grad()
        result = module.compute_loss(module(batch["reference"], batch["target"]), batch)
        result.loss.backward()
        optimizer.step()

    stream = iter(batches())
    resident = [to_device(next(stream)) for _ in range(_STEPS)]
    for batch in resident[:3]:
        step(batch)
    seconds: dict[str, list[float]] = {"from the cache": [], "from memory": []}
    for _ in range(_ROUNDS):
        for name, times in seconds.items():
            start = time.perf_counter()
            for i in range(_STEPS):
                step(to_device(next(stream)) if name == "from the cache" else resident[i])
            if device.type == "cuda":
                torch.cuda.synchronize()
            times.append(time.perf_counter() - start)
    pairs = _STEPS * datamodule.batch_size
    for name, times in seconds.items():
        print(f"{name:16s} {pairs / statistics.median(times):8.1f} pairs/s")
    ratio = statistics.median(m / c for c, m in zip(*seconds.values(), strict=True))
    p = datamodule.projection
    print(f"ratio {ratio:.3f} on {device}, batches of {datamodule.batch_size} pairs of {p.height}x{p.width} px")


if __name__ == "__main__":
    main()
