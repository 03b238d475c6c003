"""Fixtures of the commands' tests."""

import sys

import numpy as np
import pytest

from lidarlearn.commands import evaluate
from lidarlearn.data.pose_files import write_kitti_poses
from tests.box_world import BoxSequence
from tests.commands.scans import FRAMES, SENSOR


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
