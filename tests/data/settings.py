"""The settings of a data set, from its yaml."""

from typing import Any

from omegaconf import OmegaConf

from lidarlearn.commands.configs import config_directory

_OF_A_COPY = ("defaults", "_target_", "root", "train_sequences", "val_sequences", "test_sequences")


def settings_of(option: str) -> dict[str, Any]:
    """What `configs/data/<option>.yaml` gives its reader besides the root, the projection and the sequences."""
    settings = OmegaConf.to_container(OmegaConf.load(config_directory() / "data" / f"{option}.yaml"))
    return {key: value for key, value in settings.items() if key not in _OF_A_COPY}
