"""Pairs of scans and their labels."""

from collections import Counter

import numpy as np
import pytest
import torch

from lidarlearn.data.cache import VertexMaps, encode
from lidarlearn.data.pairs import ScanPairs, with_maps
from tests.box_world import SMALL, BoxSequence

LENGTHS = (5, 1, 3)  # one scan makes no pair


@pytest.fixture
def sequences():
    return [BoxSequence("3", frames=LENGTHS[0]), BoxSequence("4", frames=2), BoxSequence("5", frames=LENGTHS[2])]


@pytest.fixture
def poses(sequences):
    return [s.T_world_lidar[:length] for s, length in zip(sequences, LENGTHS, strict=True)]


@pytest.fixture
def vertex_maps(sequences, tmp_path):
    for s, length in zip(sequences, LENGTHS, strict=True):
        maps = torch.stack([encode(SMALL.vertex_map(s.scan(i).points)) for i in range(length)])
        np.save(tmp_path / f"{s.name}.npy", maps.numpy())
    return VertexMaps(*(tmp_path / f"{s.name}.npy" for s in sequences))


ROWS = (range(5), range(5, 6), range(6, 9))


def test_pairs_are_consecutive_scans_with_relative_pose(sequences, poses, vertex_maps):
    pairs = ScanPairs(ROWS, poses)
    assert len(pairs) == 6
    batch = with_maps(pairs.__getitems__([5, 0, 1, 2, 3, 4]), vertex_maps)
    assert batch["index"].tolist() == [1, 0, 1, 2, 3, 0]
    for k, (sequence, i) in enumerate([(2, 1), (0, 0), (0, 1), (0, 2), (0, 3), (2, 0)]):
        for key, scan in (("reference", i), ("target", i + 1)):
            assert torch.equal(batch[key][k], encode(SMALL.vertex_map(sequences[sequence].scan(scan).points)))
        moved = poses[sequence][i] @ batch["T_ref_new"][k]
        torch.testing.assert_close(moved, poses[sequence][i + 1])


def test_maps_in_memory_equal_those_of_files(poses, vertex_maps):
    batch = ScanPairs(ROWS, poses).__getitems__([4, 2])
    resident = vertex_maps.to(torch.device("cpu"))
    assert len(resident) == len(vertex_maps) == 9
    for key in ("reference", "target"):
        assert torch.equal(with_maps(batch, resident)[key], with_maps(batch, vertex_maps)[key])


def test_pairs_without_ground_truth_have_no_label():
    assert "T_ref_new" not in ScanPairs(ROWS, None).__getitems__([0])


def test_missing_or_nan_poses_are_refused(poses):
    with pytest.raises(ValueError, match="finite ground-truth poses, got 4, 4 of them finite"):
        ScanPairs(ROWS, [poses[0][:-1], *poses[1:]])
    with pytest.raises(ValueError, match="got 5, 0 of them finite"):
        ScanPairs(ROWS, [poses[0] * torch.nan, *poses[1:]])


def test_skips_stay_within_sequence(poses):
    pairs = ScanPairs(ROWS, poses, max_skip=4)
    torch.manual_seed(0)
    seen = set()
    for _ in range(200):
        batch = pairs.__getitems__([0, 2, 4])
        seen |= set(zip(batch["reference"].tolist(), batch["target"].tolist(), strict=True))
        moved = torch.cat(poses)[batch["reference"]] @ batch["T_ref_new"]
        torch.testing.assert_close(moved, torch.cat(poses)[batch["target"]])
    assert seen == {(0, 1), (0, 2), (0, 3), (0, 4), (2, 3), (2, 4), (6, 7), (6, 8)}


def test_skips_are_uniformly_distributed():
    pairs = ScanPairs([range(400)], None, max_skip=3)
    torch.manual_seed(0)
    batch = pairs.__getitems__(list(range(300)))
    counts = Counter((batch["target"] - batch["reference"]).tolist())
    assert set(counts) == {1, 2, 3} and min(counts.values()) > 70


def test_pairs_without_skips_draw_no_random_numbers():
    state = torch.get_rng_state()
    ScanPairs([range(400)], None).__getitems__([3])
    assert torch.equal(state, torch.get_rng_state())
