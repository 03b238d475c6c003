"""Data sets with the settings of their configs, and findings of their checks."""

from functools import cache

from hydra import compose, initialize_config_dir
from hydra.utils import instantiate
from omegaconf import DictConfig

from lidarlearn.commands.configs import config_directory
from lidarlearn.data.sequence import DataSet, LayoutReport


def data_set(name: str, root: object, **settings: object) -> DataSet:
    """What `data=name data.root=ROOT data.SETTING=...` selects; composing each config once saves most of the time."""
    return instantiate(_config(name), root=str(root), **settings)


@cache
def _config(name: str) -> DictConfig:
    with initialize_config_dir(str(config_directory()), version_base="1.3"):
        return compose("data", [f"data={name}"]).data


def findings(report: LayoutReport, level: str) -> str:
    """Subject and detail of all findings of a level, in one line."""
    return " | ".join(f"{f.what} {f.detail}" for f in report.findings if f.level == level)
