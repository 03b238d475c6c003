"""Checkpoint files: plain data that says what it was trained on, loaded without running anything of it."""

import hashlib
import pickle
from pathlib import Path
from typing import Any

import torch

from lidarlearn.errors import UserError

# What each level of a checkpoint holds, among other things.
_NEEDED = ("module", "hyper_parameters", "state_dict")
_PARTS = ("model", "loss", "optimizer", "scheduler", "trained_on")
_TOLD = ("data", "data_name", "loss", "git", "projection")


class CheckpointError(UserError):
    """A file cannot be used as a checkpoint.

    Args:
        path: the file.
        problem: what was seen.
    """

    def __init__(self, path: Path, problem: str) -> None:
        super().__init__(
            f"checkpoint {path.absolute()}: {problem}\n"
            "  change: ckpt=RUN/checkpoints/best.ckpt (or last.ckpt) of a training run of lidarlearn"
        )


def load_checkpoint(path: Path, map_location: torch.device | str = "cpu") -> dict[str, Any]:
    """The content of a checkpoint of this project; never unpickles objects.

    Raises:
        CheckpointError: the file is missing, damaged, holds more than plain data, or comes from elsewhere.
    """
    if not path.is_file():
        raise CheckpointError(path, "no such file.")
    try:
        checkpoint = torch.load(path, map_location=map_location, weights_only=True)
    except pickle.UnpicklingError as error:
        raise CheckpointError(path, "holds objects that only running its code could load, which is refused.") from error
    except (RuntimeError, EOFError, OSError) as error:
        reason = next(iter(str(error).splitlines()), "it ends too early")
        raise CheckpointError(path, f"is damaged: {reason}") from error
    level = checkpoint
    for key, needed in (("hyper_parameters", _NEEDED), ("trained_on", _PARTS), ("", _TOLD)):
        if not isinstance(level, dict) or any(name not in level for name in needed):
            raise CheckpointError(path, "was not written by lidarlearn's training.")
        level = level.get(key)
    return checkpoint


def sha256(path: Path) -> str:
    """Hexadecimal digest of a file, by which a result names the checkpoint it was made with."""
    digest = hashlib.sha256()
    with path.open("rb") as file:
        while chunk := file.read(1 << 20):
            digest.update(chunk)
    return digest.hexdigest()
