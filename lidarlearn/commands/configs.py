"""The location of the configuration files."""

from pathlib import Path

_PACKAGE = Path(__file__).resolve().parent.parent


def config_directory() -> Path:
    """The folder of the yaml files: `configs` beside the package in a source tree, inside it once installed."""
    beside = _PACKAGE.parent / "configs"
    return beside if (beside / "train.yaml").is_file() else _PACKAGE / "configs"
