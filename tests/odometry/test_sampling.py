import pytest
import torch

from lidarlearn.geometry.projection import SphericalProjection
from lidarlearn.geometry.voxels import voxel_cells
from lidarlearn.odometry.sampling import GridSampling, ImageSampling, SampledScan

IMAGE = SphericalProjection(64, 720, 3.0, -24.0)


@pytest.fixture(scope="module")
def points() -> torch.Tensor:
    points = 15 * torch.randn(30_000, 3, generator=torch.Generator().manual_seed(0))
    return points * torch.tensor([1.0, 1.0, 0.1])


def rows(points: torch.Tensor) -> set[tuple[float, ...]]:
    return {tuple(point) for point in points.tolist()}


def queries(sampled: SampledScan) -> torch.Tensor:
    return sampled.points[sampled.queries]


@pytest.mark.parametrize(("query_voxel_m", "edge_m"), [(None, 0.4), (0.4, 0.4), (0.6, 0.6)])
def test_grid_sampling_keeps_one_point_per_voxel(points, query_voxel_m, edge_m):
    points = points[:3000]
    sampled = GridSampling(0.4, query_voxel_m).sample(points)
    for chosen, among, size in ((sampled.points, points, 0.4), (queries(sampled), sampled.points, edge_m)):
        cells = voxel_cells(chosen, size)
        assert len(cells.unique(dim=0)) == len(cells) == len(voxel_cells(among, size).unique(dim=0))
        assert rows(chosen) <= rows(among)


@pytest.mark.parametrize("sampling", [GridSampling(), ImageSampling(IMAGE)])
def test_sampled_points_keep_their_times(points, sampling):
    sampled = sampling.sample(points, times=points[:, 0] / 100)
    assert torch.equal(sampled.times, sampled.points[:, 0] / 100)


@pytest.mark.parametrize("sampling", [GridSampling(), ImageSampling(IMAGE), ImageSampling(IMAGE, max_queries=100)])
def test_queries_are_distinct_points_of_map(points, sampling):
    sampled = sampling.sample(points)
    assert len(rows(queries(sampled))) == len(sampled.queries) > 0
    assert (sampled.queries.diff() > 0).all() and sampled.queries[-1] < len(sampled.points)


def test_image_sampling_keeps_nearest_point_of_each_pixel(points):
    sampled = ImageSampling(IMAGE).sample(points)
    nearest = IMAGE.nearest_points(points)
    assert torch.equal(sampled.points, points[nearest[nearest >= 0]])


def test_max_queries_are_spread_over_image(points):
    sampled = ImageSampling(IMAGE, max_queries=2000).sample(points)
    assert len(sampled.queries) == 2000
    pixel = IMAGE.pixel_index(queries(sampled))
    all_pixels = IMAGE.pixel_index(sampled.points)
    for part, parts in ((lambda p: p // 720, 64), (lambda p: p % 720 // 45, 16)):
        share = part(pixel).bincount(minlength=parts) / 2000
        expected = part(all_pixels).bincount(minlength=parts) / len(all_pixels)
        assert (share - expected).abs().max() < 0.01


@pytest.mark.parametrize("sampling", [GridSampling(), ImageSampling(IMAGE)])
@pytest.mark.parametrize("count", [0, 1])
def test_tiny_scans_are_sampled(sampling, count):
    sampled = sampling.sample(torch.tensor([[10.0, 2.0, -1.0]]).expand(count, 3))
    assert len(sampled.points) == len(sampled.queries) == count
