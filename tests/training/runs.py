"""Short trainings on the box world, composed as the command line would."""

import functools
from pathlib import Path

import torch
from hydra import compose, initialize_config_dir
from jaxtyping import Float
from omegaconf import DictConfig, OmegaConf, open_dict
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator
from torch import Tensor

from lidarlearn.commands.configs import config_directory
from lidarlearn.data.cache import decode, encode
from lidarlearn.data.sequence import Sequence
from lidarlearn.geometry import se3
from lidarlearn.training.module import PoseNetModule

_QUICK = (
    "data=kitti_00-08",  # a group without a recipe of its own; replaced below
    "device=cpu",
    "recipe=paper",
    "optimizer.lr=1e-3",
    "datamodule.batch_size=8",
    "datamodule.num_workers=0",
    "datamodule.preparation_workers=0",
    "callbacks.images.every_n_epochs=1",
    "trainer.log_every_n_steps=1",
)


@functools.cache
def _composed(*choices: str) -> DictConfig:
    with initialize_config_dir(str(config_directory()), version_base="1.3"):
        return compose("train", ["run_dir=unset", *_QUICK, *choices])


def configured(run_dir: Path, *overrides: str, draws: bool = False, **drives) -> DictConfig:
    """The config of `python train.py OVERRIDES` with `BoxDrives(**drives)` for its data.

    Args:
        run_dir: the run folder.
        overrides: `loss=icp`, `~callbacks.progress` and settings, as `trainer.max_epochs=2`.
        draws: whether images and trajectories are drawn, which takes longer than the rest of an epoch.
        drives: arguments of `BoxDrives`.
    """
    choices = [override for override in overrides if override.startswith(("loss=", "~"))]
    settings = [override.removeprefix("+") for override in overrides if override not in choices]
    config = _composed(*choices).copy()
    with open_dict(config):
        config.merge_with_dotlist([f"run_dir={run_dir}", f"datamodule.cache_root={run_dir.parent}/cache", *settings])
        config.data = {"_target_": "tests.box_world.BoxDrives", **drives}
        if not draws:
            del config.callbacks.images, config.callbacks.trajectories
    OmegaConf.resolve(config)
    return config


def curves(run_dir: Path) -> dict[str, list[tuple[int, float]]]:
    """The scalar curves of a run as (step, value), by name."""
    events = EventAccumulator(str(run_dir))
    events.Reload()
    return {tag: [(e.step, e.value) for e in events.Scalars(tag)] for tag in events.Tags()["scalars"]}


def images(run_dir: Path) -> dict[str, list[int]]:
    """The epochs at which a run logged each of its images and figures, by name."""
    events = EventAccumulator(str(run_dir))
    events.Reload()
    return {tag: [e.step for e in events.Images(tag)] for tag in events.Tags()["images"]}


def predicted(checkpoint: Path, sequence: Sequence) -> Float[Tensor, "n 4 4"]:
    """The poses of a drive, predicted by the network of a checkpoint."""
    module = PoseNetModule.load_from_checkpoint(checkpoint)
    maps = torch.stack([decode(encode(module.projection.vertex_map(scan.points))) for scan in sequence])
    return se3.accumulate(module.relative_pose(maps[:-1], maps[1:]))
