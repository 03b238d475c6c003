import pytest
import torch

from lidarlearn.geometry import se3
from lidarlearn.registration.association import KdTree
from tests.registration import maps

T_WORLD = se3.exp(torch.tensor([3.0, -2, 1, 0.1, -0.2, 0.4], dtype=torch.float64))


def clouds() -> tuple[torch.Tensor, torch.Tensor]:
    generator = torch.Generator().manual_seed(0)
    return 8 * torch.randn(5000, 3, generator=generator), 10 * torch.randn(700, 3, generator=generator)


@pytest.mark.parametrize("max_distance", [0.2, 0.5, 3.0])
def test_search_equals_brute_force(max_distance):
    points, queries = clouds()
    tree = KdTree(voxel_size_m=0.01)  # as good as no grid sampling
    tree.insert(points, T_WORLD, frames=1)
    found = tree.search(queries, max_distance)
    offsets = se3.transform(T_WORLD, points)[None] - queries[:, None]
    nearest = offsets.double().norm(dim=-1).min(dim=1)
    sure = (nearest.values - max_distance).abs() > 1e-5
    assert torch.equal(found.mask[sure], (nearest.values < max_distance)[sure])
    distances = (found.points - queries).double().norm(dim=1)
    torch.testing.assert_close(distances[found.mask], nearest.values[found.mask], rtol=0, atol=1e-5)


def test_search_uses_latest_map():
    tree = KdTree()
    points, queries = clouds()
    tree.insert(points, se3.identity(), frames=1)
    before = tree.search(queries, 1.0)
    far = points + 1000
    tree.insert(far, se3.identity(), frames=1)
    assert before.mask.any() and not tree.search(queries, 1.0).mask.any()
    assert tree.search(queries + 1000, 1.0).mask.any()


def test_normals_are_those_of_found_points():
    scene = maps.scene("room", "kd")
    floor = torch.cartesian_prod(torch.linspace(-5, 5, 11), torch.linspace(-3, 3, 7), torch.tensor([-1.73]))
    found = scene.association.search(floor, 0.5)
    upright = found.mask & (found.normals != 0).any(dim=1) & ((found.points[:, 2] + 1.73).abs() < 0.1)
    assert upright.sum() > 10
    assert found.normals[upright, 2].abs().median() > 0.99
