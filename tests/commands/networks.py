"""Checkpoints without a training."""

from pathlib import Path

import torch
from hydra.utils import instantiate

from lidarlearn.commands.train import build_module
from tests.commands.configs import composed


def save_network(path: Path, *overrides: str) -> list[str]:
    """Write the checkpoint of a network with random weights; the sequences that it names as those of its training."""
    config = composed("train", "device=cpu", *overrides)
    module = build_module(config, instantiate(config.datamodule), "folder")
    parts = dict(module.hparams)
    name = f"{type(module).__module__}.{type(module).__qualname__}"
    torch.save({"module": name, "hyper_parameters": parts, "state_dict": module.state_dict()}, path)
    return parts["trained_on"]["train_sequences"]
