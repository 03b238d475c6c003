"""Data sets with the settings of their configs, and findings of their checks."""

from functools import cache

from hydra import compose, initialize_config_dir
from hydra.utils import instantiate
from omegaconf import DictConfig

from lidarlearn.commands.configs import config_directory
from lidarlearn.data.layout import LayoutReport
from lidarlearn.data.sequence import DataSet

SPLITS = ("train_sequences", "val_sequences", "test_sequences")


def data_set(name: str, root: object, sequence: str | None = None, **settings: object) -> DataSet:
    """What `data=name data.root=ROOT data.SETTING=...` selects; composing each config once saves most of the time.

    Args:
        name: option of the group `data`.
        root: folder of the data set.
        sequence: the only sequence of all three splits; None leaves those of the config.
        settings: others than those of the config.
    """
    splits = {} if sequence is None else dict.fromkeys(SPLITS, sequence)
    return instantiate(_config(name), root=str(root), **(splits | settings))


@cache
def _config(name: str) -> DictConfig:
    with initialize_config_dir(str(config_directory()), version_base="1.3"):
        return compose("data", [f"data={name}"]).data


def findings(report: LayoutReport, level: str) -> str:
    """Subject and detail of all findings of a level, in one line."""
    return " | ".join(f"{f.what} {f.detail}" for f in report.findings if f.level == level)
