import math

import pytest
import torch

from lidarlearn.cuda_graphs import GraphCache
from lidarlearn.geometry.voxels import VoxelSums, grid_sample, voxel_cells, voxel_keys
from tests.gpu import on_gpu


def random_points(n: int, scale: float) -> torch.Tensor:
    return scale * torch.randn(n, 3, generator=torch.Generator().manual_seed(0))


@pytest.mark.parametrize(("scale", "size"), [(1.0, 0.4), (20.0, 0.4), (20.0, 1.0), (80.0, 5.0)])
def test_grid_sample_keeps_one_point_per_voxel_in_order(scale, size):
    points = random_points(3000, scale)
    occupied = {tuple(math.floor(x) for x in (point / size).tolist()) for point in points}
    kept = grid_sample(points, size)
    cells = [tuple(math.floor(x) for x in (point / size).tolist()) for point in points[kept]]
    assert cells == sorted(occupied)


def test_grid_sample_does_not_prefer_first_points():
    """A spinning LiDAR lists its points beam by beam, so the first of each voxel would lie on the same side of it."""
    voxels, each = 400, 50
    points = torch.arange(voxels).repeat(each)[:, None] + torch.full((1, 3), 0.5)
    rank = grid_sample(points, 1.0) // voxels
    assert len(rank) == voxels
    assert rank.double().mean() == pytest.approx((each - 1) / 2, abs=4 * each / math.sqrt(12 * voxels))


def test_cells_round_down_below_zero():
    points = torch.tensor([[-0.1, 0.1, -0.5], [0.1, -0.1, 0.5]])
    assert voxel_cells(points, 0.4).tolist() == [[-1, 0, -2], [0, -1, 1]]


def test_grid_sample_is_idempotent():
    points = random_points(2000, 10.0)
    once = points[grid_sample(points, 0.5)]
    assert torch.equal(grid_sample(once, 0.5), torch.arange(len(once)))


def test_grid_sample_of_empty_scan_is_empty():
    assert grid_sample(torch.zeros(0, 3), 0.4).shape == (0,)


def test_keys_are_unique_within_a_million_cells():
    edge = (1 << 20) - 1
    values = torch.tensor([-edge - 1, -edge, -1, 0, 1, edge])
    cells = torch.cartesian_prod(values, values, values)
    assert len(voxel_keys(cells).unique()) == len(cells)


def test_cells_have_any_batch_shape():
    points = random_points(24, 5.0).view(2, 3, 4, 3)
    assert torch.equal(voxel_cells(points, 0.3)[1, 2], voxel_cells(points[1, 2], 0.3))


def test_sums_over_parts_equal_sums_over_whole():
    points = random_points(3000, 3.0)
    cells, sums = voxel_cells(points, 0.5), VoxelSums(3)
    for part in torch.arange(3000).split(700):
        sums.add(cells[part], points[part])
    once, summed = sums.result()
    occupied, voxel = cells.unique(dim=0, return_inverse=True)
    assert torch.equal(once, occupied)
    torch.testing.assert_close(summed, torch.zeros(len(once), 3).index_add_(0, voxel, points))


def test_memory_of_sums_is_bounded_by_voxels(monkeypatch):
    monkeypatch.setattr(VoxelSums, "_MIN_WAITING", 0)
    points = random_points(3000, 3.0)
    cells, sums = voxel_cells(points, 0.5), VoxelSums(1)
    occupied = len(cells.unique(dim=0))
    for _ in range(50):
        sums.add(cells, torch.ones(3000, 1))
        assert sum(len(part) for part, _ in sums._parts) <= 3 * occupied
    assert sums.result()[1].sum() == 50 * 3000


def test_sums_over_nothing_are_empty():
    cells, sums = VoxelSums(2).result()
    assert cells.shape == (0, 3) and sums.shape == (0, 2)


@on_gpu
def test_gpu_samples_same_points():
    """The first call is eager, the second is captured, the third replayed."""
    graphs = GraphCache()
    for seed in range(4):
        points = 50 * torch.rand(3000 + seed, 3, generator=torch.Generator().manual_seed(seed)) - 25
        index = grid_sample(points, 0.8)
        assert torch.equal(grid_sample(points.cuda(), 0.8, graphs).cpu(), index)
        assert torch.equal(grid_sample(points.cuda(), 0.8).cpu(), index)
