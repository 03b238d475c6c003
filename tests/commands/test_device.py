"""The device of a run."""

import pytest
import torch
from hydra.utils import instantiate
from lightning.pytorch.accelerators import CPUAccelerator
from omegaconf import OmegaConf

from lidarlearn.commands.device import resolve_device
from lidarlearn.errors import UserError
from tests.commands.configs import composed


@pytest.mark.parametrize(("has_cuda", "device"), [(False, "cpu"), (True, "cuda")])
def test_auto_device_is_cuda_if_available_else_cpu(monkeypatch, has_cuda, device):
    monkeypatch.setattr(torch.cuda, "is_available", lambda: has_cuda)
    monkeypatch.setattr(torch.backends.mps, "is_available", lambda: True)
    config = OmegaConf.create({"device": "auto", "trainer": {"accelerator": "${device}"}})
    resolve_device(config)
    assert config.device == config.trainer.accelerator == device


@pytest.mark.parametrize("device", ["cuda", "mps", "gpu"])
def test_unavailable_device_is_refused(monkeypatch, device):
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    with pytest.raises(UserError, match="change: device=auto"):
        resolve_device(OmegaConf.create({"device": device}))


def test_training_uses_a_single_device_by_default():
    trainer = instantiate(composed("train", "device=cpu").trainer)
    assert trainer.num_devices == 1 and isinstance(trainer.accelerator, CPUAccelerator)


def test_number_of_training_devices_can_be_set():
    assert composed("train", "trainer.devices=2").trainer.devices == 2
