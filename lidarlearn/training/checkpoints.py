"""Checkpoint files: plain data that record what they were trained on; loading one runs none of its code."""

import hashlib
import pickle
from pathlib import Path
from typing import Any

import torch

from lidarlearn.errors import UserError
from lidarlearn.training.parts import PARTS

# Keys that every checkpoint has: at the top, in its "hyper_parameters", and in their "trained_on".
_KEYS = ("module", "hyper_parameters", "state_dict")
_HYPER_PARAMETER_KEYS = (*PARTS, "trained_on")
_TRAINED_ON_KEYS = ("data", "data_name", "loss", "git", "projection")


class CheckpointError(UserError):
    """A file cannot be used as a checkpoint.

    Args:
        path: the file.
        problem: what is wrong with it.
    """

    def __init__(self, path: Path, problem: str) -> None:
        super().__init__(
            f"checkpoint {path.absolute()}: {problem}\n"
            "  change: ckpt=RUN/checkpoints/best.ckpt (or last.ckpt) of a training run of lidarlearn"
        )


def load_checkpoint(path: Path, map_location: torch.device | str = "cpu") -> dict[str, Any]:
    """Load a checkpoint of this project; never unpickles objects.

    Raises:
        CheckpointError: the file is missing, damaged, holds more than plain data, or is not this project's.
    """
    if not path.is_file():
        raise CheckpointError(path, "no such file.")
    try:
        checkpoint = torch.load(path, map_location=map_location, weights_only=True)
    except pickle.UnpicklingError as error:
        raise CheckpointError(path, "holds objects that load only by running its code, which is refused.") from error
    except (RuntimeError, EOFError, OSError) as error:
        reason = next(iter(str(error).splitlines()), "it ends too early")
        raise CheckpointError(path, f"is damaged: {reason}") from error
    level = checkpoint
    for keys, below in ((_KEYS, "hyper_parameters"), (_HYPER_PARAMETER_KEYS, "trained_on"), (_TRAINED_ON_KEYS, "")):
        if not isinstance(level, dict) or any(key not in level for key in keys):
            raise CheckpointError(path, "was not written by lidarlearn's training.")
        level = level.get(below)
    return checkpoint


def sha256(path: Path) -> str:
    """Hexadecimal digest of a file; results identify their checkpoint by it."""
    digest = hashlib.sha256()
    with path.open("rb") as file:
        while chunk := file.read(1 << 20):
            digest.update(chunk)
    return digest.hexdigest()
