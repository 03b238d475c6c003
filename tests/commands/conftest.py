"""Fixtures of the commands' tests."""

import sys

import numpy as np
import pytest
import torchvision
from torch import nn

from lidarlearn.commands import evaluate
from lidarlearn.data.pose_files import write_kitti_poses
from tests.box_world import BoxSequence
from tests.commands.scans import FRAMES, SENSOR


class SmallBackbone(nn.Module):
    """As torchvision's residual networks to PoseNet, with few parameters."""

    def __init__(self, name: str, weights: None, num_classes: int) -> None:
        super().__init__()
        self.conv1 = nn.Conv2d(3, 32, kernel_size=7)  # replaced by PoseNet
        self.conv2 = nn.Conv2d(32, 32, kernel_size=3, stride=2, padding=1)
        self.fc = nn.Linear(32, num_classes)

    def forward(self, x):
        return self.fc(self.conv2(self.conv1(x).relu()).relu().mean(dim=(2, 3)))


@pytest.fixture(scope="session", autouse=True)
def small_backbone():
    """Training, saving and loading ResNet-18 would take most of the time, and commands do the same with any network."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(torchvision.models, "get_model", SmallBackbone)
        yield


@pytest.fixture(scope="session")
def scans(tmp_path_factory):
    """Two drives with ground truth as a folder of .npy files."""
    root = tmp_path_factory.mktemp("scans")
    for name in ("0", "1"):
        drive = BoxSequence(name, FRAMES)
        (root / name).mkdir()
        for i, scan in enumerate(drive):
            np.save(root / name / f"{i}.npy", scan.points.numpy())
        write_kitti_poses(root / name / "poses.txt", drive.T_world_lidar)
    return root


@pytest.fixture
def call(monkeypatch, capsys, scans):
    """Runs evaluate.py on the folder; what it prints."""

    def run(*arguments):
        own = ["device=cpu", "data=folder", f"data.root={scans}", *SENSOR]
        monkeypatch.setattr(sys, "argv", ["evaluate.py", *arguments, *own])
        evaluate.main()
        return capsys.readouterr().out

    return run


@pytest.fixture
def no_plots(monkeypatch):
    """Drawing takes longer than everything else."""
    monkeypatch.setattr(evaluate, "figures", lambda *_: iter(()))
