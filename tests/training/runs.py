"""Short trainings on the box world, composed as the command line would."""

from pathlib import Path

from hydra import compose, initialize_config_dir
from omegaconf import DictConfig, OmegaConf, open_dict
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

from lidarlearn.commands.configs import config_directory

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


def configured(run_dir: Path, *overrides: str, **drives) -> DictConfig:
    """The config of `python train.py OVERRIDES` with `BoxDrives(**drives)` for its data."""
    with initialize_config_dir(str(config_directory()), version_base="1.3"):
        config = compose(
            "train", [f"run_dir={run_dir}", f"datamodule.cache_root={run_dir.parent}/cache", *_QUICK, *overrides]
        )
    with open_dict(config):
        config.data = {"_target_": "tests.box_world.BoxDrives", **drives}
    OmegaConf.resolve(config)
    return config


def curves(run_dir: Path) -> dict[str, list[tuple[int, float]]]:
    """Every scalar curve of a run as (step, value)."""
    events = EventAccumulator(str(run_dir))
    events.Reload()
    return {tag: [(e.step, e.value) for e in events.Scalars(tag)] for tag in events.Tags()["scalars"]}


def image_tags(run_dir: Path) -> list[str]:
    """Names of the images and figures of a run."""
    events = EventAccumulator(str(run_dir))
    events.Reload()
    return events.Tags()["images"]
