"""The device of a run."""

import torch
from omegaconf import DictConfig, open_dict

from lidarlearn.errors import UserError


def resolve_device(config: DictConfig) -> None:
    """Replace `device=auto` with cuda or cpu. Other devices cannot compute in float64.

    Raises:
        UserError: the device does not exist, or is not supported.
    """
    name = config.device
    if name == "auto":
        name = "cuda" if torch.cuda.is_available() else "cpu"
    if name == "cuda" and not torch.cuda.is_available():
        raise UserError("device=cuda: torch finds no CUDA device\n  change: device=auto or device=cpu")
    if name not in ("cpu", "cuda"):
        raise UserError(f"device={name} is not supported\n  change: device=auto, cpu or cuda")
    with open_dict(config):
        config.device = name
