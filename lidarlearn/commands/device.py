"""Where a run computes."""

import torch
from omegaconf import DictConfig, open_dict

from lidarlearn.errors import UserError


def resolve_device(config: DictConfig) -> None:
    """Let `device=auto` become cuda or cpu; there is no other device on which float64 can be computed.

    Raises:
        UserError: there is no such device.
    """
    name = config.device
    if name == "auto":
        name = "cuda" if torch.cuda.is_available() else "cpu"
    if name == "cuda" and not torch.cuda.is_available():
        raise UserError("device=cuda: torch finds no CUDA device\n  change: device=auto or device=cpu")
    if name not in ("cpu", "cuda"):
        raise UserError(f"device={name}: there is no such device\n  change: device=auto, cpu or cuda")
    with open_dict(config):
        config.device = name
