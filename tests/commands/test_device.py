"""Runs compute on the CPU or a CUDA device, and on one alone unless told otherwise."""

import pytest
import torch
from hydra import compose, initialize_config_dir
from hydra.utils import instantiate
from lightning.pytorch.accelerators import CPUAccelerator
from omegaconf import OmegaConf

from lidarlearn.commands.configs import config_directory
from lidarlearn.commands.device import resolve_device
from lidarlearn.errors import UserError


@pytest.mark.parametrize(("has_cuda", "device"), [(False, "cpu"), (True, "cuda")])
def test_auto_is_cuda_or_the_cpu_whatever_else_there_is(monkeypatch, has_cuda, device):
    monkeypatch.setattr(torch.cuda, "is_available", lambda: has_cuda)
    monkeypatch.setattr(torch.backends.mps, "is_available", lambda: True)
    config = OmegaConf.create({"device": "auto", "trainer": {"accelerator": "${device}"}})
    resolve_device(config)
    assert config.device == config.trainer.accelerator == device


@pytest.mark.parametrize("device", ["cuda", "mps", "gpu"])
def test_a_device_that_is_not_there_says_so(monkeypatch, device):
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    with pytest.raises(UserError, match="change: device=auto"):
        resolve_device(OmegaConf.create({"device": device}))


def test_one_device_trains_unless_more_are_asked_for():
    with initialize_config_dir(str(config_directory()), version_base="1.3"):
        one, two = (compose("train", ["run_dir=x", "device=cpu", *more]) for more in ([], ["trainer.devices=2"]))
    trainer = instantiate(one.trainer)
    assert (trainer.num_devices, two.trainer.devices) == (1, 2) and isinstance(trainer.accelerator, CPUAccelerator)
