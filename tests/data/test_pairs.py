"""Pairs of scans and their labels."""

import numpy as np
import pytest
import torch

from lidarlearn.data.cache import VertexMaps, encode
from lidarlearn.data.pairs import ScanPairs
from lidarlearn.geometry import se3
from tests.box_world import SMALL, BoxSequence


@pytest.fixture
def sequence():
    return BoxSequence("3", frames=5)


@pytest.fixture
def vertex_maps(sequence, tmp_path):
    np.save(tmp_path / "maps.npy", torch.stack([encode(SMALL.vertex_map(s.points)) for s in sequence]).numpy())
    return VertexMaps(tmp_path / "maps.npy")


def test_consecutive_scans_and_the_motion_between_them(sequence, vertex_maps):
    pairs = ScanPairs(vertex_maps, sequence.T_world_lidar)
    assert len(pairs) == 4
    for i in range(4):
        pair = pairs[i]
        assert pair["index"] == i
        torch.testing.assert_close(pair["reference"], vertex_maps[i])
        torch.testing.assert_close(pair["target"], vertex_maps[i + 1])
        moved = se3.transform(pair["T_ref_new"], torch.zeros(1, 3, dtype=torch.float64))
        world = se3.transform(sequence.T_world_lidar[i], moved)
        torch.testing.assert_close(world[0], sequence.T_world_lidar[i + 1, :3, 3])


def test_no_ground_truth_no_label(vertex_maps):
    assert "T_ref_new" not in ScanPairs(vertex_maps, None)[0]


def test_poses_that_do_not_belong_to_the_scans_are_refused(sequence, vertex_maps):
    with pytest.raises(ValueError, match="finite ground-truth poses, got 4"):
        ScanPairs(vertex_maps, sequence.T_world_lidar[:-1])
    with pytest.raises(ValueError, match="finite"):
        ScanPairs(vertex_maps, sequence.T_world_lidar * torch.nan)


def test_a_pair_may_skip_scans_but_not_beyond_the_last(sequence, vertex_maps):
    pairs = ScanPairs(vertex_maps, sequence.T_world_lidar, step=lambda: 3)
    assert len(pairs) == 4
    for first, second in ((0, 3), (1, 4), (2, 4), (3, 4)):
        assert torch.equal(pairs[first]["target"], vertex_maps[second])
        moved = sequence.T_world_lidar[first] @ pairs[first]["T_ref_new"]
        torch.testing.assert_close(moved, sequence.T_world_lidar[second])
