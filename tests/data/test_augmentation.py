"""Augmented pairs of scans are consistent: registration of their scans gives their labels."""

import pytest
import torch

from lidarlearn.data.augmentation import Augmentation, mirrored, reversed_in_time, thinned, turned
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
    maps = [FINE.vertex_map(cast(pose, FINE)) for pose in (se3.identity(), T)]
    return Pair(reference=maps[0], target=maps[1], index=torch.tensor(3), T_ref_new=T)


def batch_of(pair: Pair, n: int) -> Pair:
    """`n` copies of a pair; `index` counts them."""
    return {key: value.expand(n, *value.shape) for key, value in pair.items()} | {"index": torch.arange(n)}


def assert_registration_confirms_label(pair: Pair) -> None:
    """Registration that starts beside the label ends at it, and points are in their own pixels."""
    reference, target = (pair[key].flatten(1).T for key in ("reference", "target"))
    reference, target = (points[(points != 0).any(1)] for points in (reference, target))
    tree = KdTree()
    tree.insert(reference, se3.identity(), frames=1)
    result = GaussNewton().register(target, tree, pair["T_ref_new"] @ se3.from_euler(OFF), 1.0)
    error = se3.log(se3.inverse(pair["T_ref_new"]) @ result.T_world_lidar)
    assert error[:3].norm() < 0.02 and error[3:].norm() < 0.005
    for key in ("reference", "target"):
        vertex_map = pair[key]
        again = FINE.vertex_map(vertex_map.flatten(1).T)
        assert (activated(again) & activated(vertex_map)).sum() > 0.98 * activated(vertex_map).sum()


CHANGES = {
    "none": lambda pair: pair,
    "mirrored": mirrored,
    "turned by 37 columns": lambda pair: turned(pair, torch.tensor(37)),
    "turned by 275 columns": lambda pair: turned(pair, torch.tensor(275)),
    "reversed": reversed_in_time,
    "thinned": lambda pair: thinned(pair, *(torch.rand(2, 32, 360) > 0.4)),
    "all": lambda pair: mirrored(turned(reversed_in_time(pair), torch.tensor(100))),
}


@pytest.mark.parametrize("change", CHANGES)
def test_augmented_scans_register_to_label(change, pair):
    torch.manual_seed(0)
    changed = CHANGES[change](pair)
    assert changed.keys() == pair.keys() and changed["index"] == 3
    assert changed["reference"].dtype == torch.float32
    assert (change == "none") == torch.equal(changed["reference"], pair["reference"])
    assert_registration_confirms_label(changed)


def test_mirrored_map_equals_map_of_mirrored_scan(pair):
    image = mirrored(pair)
    flip = torch.tensor([1.0, -1, 1])
    for key, pose in (("reference", se3.identity()), ("target", pair["T_ref_new"])):
        seen = FINE.vertex_map(cast(pose, FINE) * flip)
        # Points exactly on the border of a pixel may fall into its neighbour.
        same = ((image[key] - seen).abs().amax(0) < 0.01).float().mean()
        assert same > 0.98
    torch.testing.assert_close(se3.to_euler(image["T_ref_new"]), MOTION * torch.tensor([1, -1, 1, -1, 1, -1]))


def test_turning_rotates_direction_of_motion(pair):
    quarter = turned(pair, torch.tensor(90))  # to the left
    assert se3.to_euler(quarter["T_ref_new"])[:3].tolist() == pytest.approx([-0.05, -0.4, 0.01], abs=1e-9)
    assert se3.rotation_angle(quarter["T_ref_new"]) == pytest.approx(se3.rotation_angle(pair["T_ref_new"]))


def test_batch_is_augmented_pair_by_pair(pair):
    """Random numbers are drawn for the whole batch, but act on each pair as the single functions do."""
    n = 16
    torch.manual_seed(1)
    batch = Augmentation(mirror=True, reverse=True, turn=True)(batch_of(pair, n))
    torch.manual_seed(1)
    mirror, reverse, columns = torch.rand(n) < 0.5, torch.rand(n) < 0.5, torch.randint(FINE.width, (n,))
    assert 0 < int(mirror.sum()) < n and 0 < int(reverse.sum()) < n
    for i in range(n):
        expected = mirrored(pair) if mirror[i] else pair
        expected = turned(reversed_in_time(expected) if reverse[i] else expected, columns[i])
        for key in ("reference", "target", "T_ref_new"):
            torch.testing.assert_close(batch[key][i], expected[key], atol=1e-5, rtol=1e-5)
    assert batch["index"].tolist() == list(range(n))


@pytest.mark.parametrize("change", ["mirrored", "turned", "reversed"])
def test_inverse_change_restores_pair(change, pair):
    undo = {
        "mirrored": lambda: mirrored(mirrored(pair)),
        "turned": lambda: turned(turned(pair, torch.tensor(50)), torch.tensor(310)),
        "reversed": lambda: reversed_in_time(reversed_in_time(pair)),
    }
    again = undo[change]()
    for key in ("reference", "target"):
        assert (again[key] - pair[key]).abs().max() < 1e-4
    torch.testing.assert_close(again["T_ref_new"], pair["T_ref_new"])


def test_augmentation_adds_no_label(pair):
    bare = batch_of({key: pair[key] for key in ("reference", "target", "index")}, 8)
    all_changes = Augmentation(mirror=True, turn=True, reverse=True, drop_out=0.3)
    assert "T_ref_new" not in all_changes(bare)


def test_half_of_pairs_are_mirrored(pair):
    torch.manual_seed(0)
    batch = Augmentation(mirror=True)(batch_of(pair, 200))
    assert 70 < sum(torch.equal(image, pair["reference"]) for image in batch["reference"]) < 130


def test_drop_out_is_limited_to_given_share(pair):
    torch.manual_seed(0)
    before = int(activated(pair["reference"]).sum())
    batch = Augmentation(drop_out=0.5)(batch_of(pair, 40))
    for key in ("reference", "target"):
        shares = 1 - activated(batch[key]).sum((1, 2)) / before
        assert shares.max() < 0.53 and shares.max() > 0.3 and shares.min() < 0.2
    assert not torch.equal(activated(batch["reference"]), activated(batch["target"]))


def test_equal_seeds_give_equal_batches(pair):
    """A resumed training must see the batches of an uninterrupted one."""
    all_changes = Augmentation(mirror=True, turn=True, reverse=True, drop_out=0.3)
    batches = []
    for _ in range(2):
        torch.manual_seed(3)
        batches.append(all_changes(batch_of(pair, 4)))
    assert all(torch.equal(batches[0][key], batches[1][key]) for key in batches[0])


def test_dropped_pixels_differ_between_batches(pair):
    torch.manual_seed(0)
    first, second = (activated(Augmentation(drop_out=0.5)(batch_of(pair, 1))["reference"]) for _ in range(2))
    assert not torch.equal(first, second)


def test_disabled_augmentation_draws_no_random_numbers(pair):
    state = torch.get_rng_state()
    batch = batch_of(pair, 2)
    same = Augmentation()(batch)
    assert torch.equal(state, torch.get_rng_state())
    assert all(same[key] is batch[key] for key in batch)


def test_settings_out_of_range_are_refused():
    for settings in ({"max_skip": 0}, {"drop_out": 1.0}, {"drop_out": -0.1}):
        with pytest.raises(ValueError, match="max_skip >= 1"):
            Augmentation(**settings)
