"""Fixtures that several packages' tests share."""

import os
from collections import OrderedDict
from collections.abc import Iterator
from pathlib import Path

import pytest
import torch
from torch import nn

if "PYTEST_XDIST_WORKER" in os.environ:
    torch.set_num_threads(1)  # the tests share the cores, one process each


@pytest.fixture(scope="session")
def real_data() -> Path:
    """The folder of real scans; tests that need it are marked `realdata` and skip without it."""
    folder = os.environ.get("LIDARLEARN_TEST_DATA")
    if not folder:
        pytest.skip("set LIDARLEARN_TEST_DATA to the folder of real scans to run this test")
    return Path(folder)


@pytest.fixture(scope="module")
def small_network() -> Iterator[None]:
    """Networks of a hundredth of ResNet-18's size in this module's tests, for what does not depend on the size."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("torchvision.models.get_model", _small_backbone)
        yield


def _small_backbone(name: str, weights: None, num_classes: int) -> nn.Module:
    """Layers under torchvision's names, two of which `PoseNet` relies on: `conv1` and `fc`."""
    layers = OrderedDict(
        conv1=nn.Conv2d(3, 16, kernel_size=7, stride=2, padding=3),
        bn1=nn.BatchNorm2d(16),
        relu1=nn.ReLU(),
        conv2=nn.Conv2d(16, 64, kernel_size=3, stride=2, padding=1),
        bn2=nn.BatchNorm2d(64),
        relu2=nn.ReLU(),
        conv3=nn.Conv2d(64, 128, kernel_size=3, stride=2, padding=1),
        bn3=nn.BatchNorm2d(128),
        relu3=nn.ReLU(),
        avgpool=nn.AdaptiveAvgPool2d(1),
        flatten=nn.Flatten(),
        fc=nn.Linear(128, num_classes),
    )
    return nn.Sequential(layers)
