"""Fixtures of the commands' tests."""

import numpy as np
import pytest

from lidarlearn.evaluation.trajectories import write_kitti
from tests.box_world import BoxSequence
from tests.commands.scans import FRAMES


@pytest.fixture(scope="session")
def scans(tmp_path_factory):
    """Two drives with ground truth as a folder of .npy files."""
    root = tmp_path_factory.mktemp("scans")
    for name in ("0", "1"):
        drive = BoxSequence(name, FRAMES)
        (root / name).mkdir()
        for i, scan in enumerate(drive):
            np.save(root / name / f"{i}.npy", scan.points.numpy())
        write_kitti(root / name / "poses.txt", drive.T_world_lidar)
    return root
