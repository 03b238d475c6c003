import pytest
import torch

from lidarlearn.geometry import se3
from lidarlearn.registration.association import KdTree, VoxelHash
from tests.registration import maps

VOXEL = 0.4


@pytest.fixture(scope="module", params=["room", "street"])
def both(request) -> tuple[KdTree, VoxelHash, torch.Tensor]:
    """The same map in both structures, and queries somewhere near it."""
    scene, other = maps.scene(request.param, "kd"), maps.scene(request.param, "vh")
    generator = torch.Generator().manual_seed(0)
    queries = se3.transform(scene.T_world_lidar, scene.queries)
    queries = queries + 0.2 * torch.randn(queries.shape, generator=generator)
    return scene.association, other.association, queries


@pytest.mark.parametrize("distance", [VOXEL, 0.5, 0.8, 1.1, 1.6])
def test_search_is_exact_up_to_four_voxel_edges(both, distance, record_property):
    tree, table, queries = both
    generator = torch.Generator().manual_seed(1)
    queries = queries + distance / 3 * torch.randn(queries.shape, generator=generator)
    exact, found = tree.search(queries, distance), table.search(queries, distance)
    assert exact.mask.sum() > 200 and torch.equal(exact.mask, found.mask)
    to_exact, to_found = ((c.points - queries)[exact.mask].norm(dim=1) for c in (exact, found))
    torch.testing.assert_close(to_found, to_exact, rtol=0, atol=1e-5)
    same = (exact.points == found.points).all(dim=1)[exact.mask]
    record_property("recall", same.double().mean().item())
    assert same.double().mean() > 0.999  # but for ties


def test_widest_search_reaches_four_voxel_edges(both):
    tree, table, queries = both
    shifted = queries + torch.tensor([0.0, 0.0, 1.0])
    exact, found = tree.search(shifted, 3.0), table.search(shifted, 3.0)
    near = exact.mask & ((exact.points - shifted).norm(dim=1) < 4 * VOXEL)
    assert near.sum() > 200 and found.mask[near].all()


def test_search_in_pieces_equals_search_at_once(both, monkeypatch):
    _, table, queries = both
    whole = table.search(queries, 1.6)
    monkeypatch.setattr("lidarlearn.registration.association.voxel_hash._MAX_CANDIDATES_AT_ONCE", 10_000)
    pieces = table.search(queries, 1.6)
    assert torch.equal(whole.mask, pieces.mask)
    assert torch.equal(whole.points[whole.mask], pieces.points[whole.mask])


def test_voxels_with_same_table_entry_are_distinguished():
    """The table wraps around in space, every 512 or 64 voxels."""
    table = VoxelHash(VOXEL)
    points = torch.tensor([[0.2, 0.2, 0.2], [30.2, 0.2, 0.2]])
    table.insert(points, se3.identity(), frames=30)
    for period in ([512, 0, 0], [0, 512, 0], [0, 0, 64], [-512, 512, 64]):
        away = points + VOXEL * torch.tensor(period)
        assert not table.search(away, VOXEL).mask.any()
    assert table.search(points, VOXEL).mask.all()


def test_normals_equal_those_of_kdtree(both):
    tree, table, queries = both
    exact, found = tree.search(queries, VOXEL), table.search(queries, VOXEL)
    same = exact.mask & found.mask & (exact.points == found.points).all(dim=1)
    torch.testing.assert_close(exact.normals[same], found.normals[same])
