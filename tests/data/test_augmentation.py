"""Changed pairs are those of a changed drive: their scans register to their labels."""

from collections import Counter

import pytest
import torch

from lidarlearn.data.augmentation import Augmentation, mirrored, reversed_in_time, thinned, turned
from lidarlearn.data.cache import decode, encode
from lidarlearn.data.pairs import Pair
from lidarlearn.geometry import se3
from lidarlearn.geometry.projection import SphericalProjection, activated
from lidarlearn.registration.association import KdTree
from lidarlearn.registration.gauss_newton import GaussNewton
from tests.box_world import cast

FINE = SphericalProjection(height=32, width=360, fov_up_deg=15.0, fov_down_deg=-20.0)
MOTION = torch.tensor([0.4, -0.05, 0.01, 0.004, -0.006, 0.05], dtype=torch.float64)
OFF = torch.tensor([0.1, 0.1, 0.0, 0.0, 0.0, 0.02], dtype=torch.float64)


@pytest.fixture(scope="module")
def pair() -> Pair:
    T = se3.from_euler(MOTION)
    maps = [encode(FINE.vertex_map(cast(pose, FINE))) for pose in (se3.identity(), T)]
    return Pair(reference=maps[0], target=maps[1], index=3, T_ref_new=T)


def assert_scans_and_label_agree(pair: Pair) -> None:
    """Registration, started a little off the label, ends at the label, and in a pixel of its own for each point."""
    reference, target = (decode(pair[key]).flatten(1).T for key in ("reference", "target"))
    reference, target = (points[(points != 0).any(1)] for points in (reference, target))
    tree = KdTree()
    tree.insert(reference, se3.identity(), frames=1)
    result = GaussNewton().register(target, tree, pair["T_ref_new"] @ se3.from_euler(OFF), 1.0)
    error = se3.log(se3.inverse(pair["T_ref_new"]) @ result.T_world_lidar)
    assert error[:3].norm() < 0.02 and error[3:].norm() < 0.005
    for key in ("reference", "target"):
        vertex_map = decode(pair[key])
        again = FINE.vertex_map(vertex_map.flatten(1).T)
        assert (activated(again) & activated(vertex_map)).sum() > 0.98 * activated(vertex_map).sum()


CHANGES = {
    "none": lambda pair: pair,
    "mirrored": mirrored,
    "turned by 37 columns": lambda pair: turned(pair, 37),
    "turned by 275 columns": lambda pair: turned(pair, 275),
    "reversed": reversed_in_time,
    "thinned": lambda pair: thinned(pair, *(torch.rand(2, 32, 360) > 0.4)),
    "all": lambda pair: mirrored(turned(reversed_in_time(pair), 100)),
}


@pytest.mark.parametrize("change", CHANGES)
def test_scans_and_label_still_agree(change, pair):
    torch.manual_seed(0)
    changed = CHANGES[change](pair)
    assert changed.keys() == pair.keys() and changed["index"] == 3
    assert changed["reference"].dtype == torch.int16
    assert (change == "none") == torch.equal(changed["reference"], pair["reference"])
    assert_scans_and_label_agree(changed)


def test_the_mirror_image_is_what_a_mirrored_drive_would_have_seen(pair):
    image = mirrored(pair)
    flip = torch.tensor([1.0, -1, 1])
    for key, pose in (("reference", se3.identity()), ("target", pair["T_ref_new"])):
        seen = FINE.vertex_map(cast(pose, FINE) * flip)
        # Points exactly on a pixel's border may change sides.
        same = ((decode(image[key]) - seen).abs().amax(0) < 0.01).float().mean()
        assert same > 0.98
    torch.testing.assert_close(se3.to_euler(image["T_ref_new"]), MOTION * torch.tensor([1, -1, 1, -1, 1, -1]))


def test_a_turned_sensor_moves_in_another_direction_by_the_same_distance(pair):
    quarter = turned(pair, 90)  # to the left: what was ahead is to the right
    assert se3.to_euler(quarter["T_ref_new"])[:3].tolist() == pytest.approx([-0.05, -0.4, 0.01], abs=1e-9)
    assert se3.rotation_angle(quarter["T_ref_new"]) == pytest.approx(se3.rotation_angle(pair["T_ref_new"]))


def test_points_turned_beyond_what_16_bits_hold_are_lost_rather_than_elsewhere():
    vertex_map = torch.zeros(3, 1, 8)
    vertex_map[:, 0, 0] = torch.tensor([120.0, 100.0, 0.0])  # 156 m away
    vertex_map[:, 0, 4] = torch.tensor([-20.0, 10.0, 1.0])
    far = Pair(reference=encode(vertex_map), target=encode(vertex_map), index=0)
    turned_map = decode(turned(far, 1)["reference"])  # by 45 deg
    assert activated(turned_map).nonzero().tolist() == [[0, 5]]
    assert turned_map[:, 0, 5].tolist() == pytest.approx([-7.071, 21.213, 1.0], abs=0.003)


@pytest.mark.parametrize("change", ["mirrored", "turned", "reversed"])
def test_undone_it_is_no_change(change, pair):
    undo = {
        "mirrored": lambda: mirrored(mirrored(pair)),
        "turned": lambda: turned(turned(pair, 50), 310),
        "reversed": lambda: reversed_in_time(reversed_in_time(pair)),
    }
    again = undo[change]()
    for key in ("reference", "target"):
        assert (again[key] - pair[key]).abs().max() <= 1  # steps of 4 mm
    torch.testing.assert_close(again["T_ref_new"], pair["T_ref_new"])


def test_without_a_label_none_is_made_up(pair):
    bare = Pair(reference=pair["reference"], target=pair["target"], index=0)
    everything = Augmentation(mirror=True, turn=True, reverse=True, drop_out=0.3)
    assert all("T_ref_new" not in everything(bare) for _ in range(8))


def test_half_of_the_pairs_are_mirrored(pair):
    torch.manual_seed(0)
    counts = Counter(torch.equal(Augmentation(mirror=True)(pair)["reference"], pair["reference"]) for _ in range(200))
    assert 70 < counts[True] < 130


def test_steps_are_spread_evenly():
    torch.manual_seed(0)
    counts = Counter(Augmentation(max_skip=3).step() for _ in range(300))
    assert set(counts) == {1, 2, 3} and min(counts.values()) > 70
    assert Augmentation().step() == 1


def test_no_more_is_dropped_than_asked_for(pair):
    torch.manual_seed(0)
    before = int(pair["reference"].any(0).sum())
    shares = [1 - int(Augmentation(drop_out=0.5)(pair)["reference"].any(0).sum()) / before for _ in range(40)]
    assert max(shares) < 0.53 and max(shares) > 0.3 and min(shares) < 0.2


def test_nothing_is_left_to_chance_that_is_switched_off(pair):
    state = torch.get_rng_state()
    same = Augmentation()(pair)
    assert torch.equal(state, torch.get_rng_state())
    assert all(same[key] is pair[key] for key in pair)


def test_settings_out_of_range_are_refused():
    for settings in ({"max_skip": 0}, {"drop_out": 1.0}, {"drop_out": -0.1}):
        with pytest.raises(ValueError, match="max_skip >= 1"):
            Augmentation(**settings)
