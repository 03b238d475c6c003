"""Pairs of scans and their mirror images."""

from collections import Counter

import numpy as np
import pytest
import torch

from lidarlearn.data.cache import VertexMaps, decode, encode
from lidarlearn.data.pairs import ScanPairs, mirrored
from lidarlearn.geometry import se3
from tests.box_world import SMALL, BoxSequence, cast


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


def test_the_mirror_image_is_what_a_mirrored_drive_would_have_seen(sequence, vertex_maps):
    pair = ScanPairs(vertex_maps, sequence.T_world_lidar)[2]
    image = mirrored(pair)
    flip = torch.tensor([1.0, -1, 1])
    for key, index in (("reference", 2), ("target", 3)):
        seen = SMALL.vertex_map(cast(sequence.T_world_lidar[index]) * flip)
        # Points exactly on a pixel's border may change sides.
        same = ((decode(image[key]) - seen).abs().amax(0) < 0.01).float().mean()
        assert same > 0.98
    x, y, z, roll, pitch, yaw = se3.to_euler(pair["T_ref_new"])
    expected = torch.stack([x, -y, z, -roll, pitch, -yaw])
    torch.testing.assert_close(se3.to_euler(image["T_ref_new"]), expected)


def test_mirroring_twice_is_no_change(sequence, vertex_maps):
    pair = ScanPairs(vertex_maps, sequence.T_world_lidar)[1]
    twice = mirrored(mirrored(pair))
    for key in pair:
        torch.testing.assert_close(twice[key], pair[key])


def test_about_every_other_training_pair_is_mirrored(sequence, vertex_maps):
    torch.manual_seed(0)
    pairs = ScanPairs(vertex_maps, sequence.T_world_lidar, mirror=True)
    plain, image = ScanPairs(vertex_maps, sequence.T_world_lidar)[1], mirrored(pairs[1])
    counts = Counter(bool((pairs[1]["reference"] == plain["reference"]).all()) for _ in range(200))
    assert image.keys() == plain.keys()
    assert 70 < counts[True] < 130
