import pytest
import torch

from lidarlearn.geometry.projection import SphericalProjection
from lidarlearn.geometry.voxels import voxel_cells
from lidarlearn.odometry.sampling import GridSampling, ImageSampling, map_voxel_m, query_voxel_m

IMAGE = SphericalProjection(64, 720, 3.0, -24.0)


@pytest.fixture(scope="module")
def points() -> torch.Tensor:
    points = 15 * torch.randn(30_000, 3, generator=torch.Generator().manual_seed(0))
    return points * torch.tensor([1.0, 1.0, 0.1])


def test_the_grid_holds_one_point_per_voxel_for_map_and_queries(points):
    sampled = GridSampling(0.4, 1.0).sample(points)
    in_map = points[sampled.map_index]
    for source, index, size in ((points, sampled.map_index, 0.4), (in_map, sampled.query_index, 1.0)):
        cells = voxel_cells(points[index], size)
        assert len(cells.unique(dim=0)) == len(cells) == len(voxel_cells(source, size).unique(dim=0))


@pytest.mark.parametrize(("rows", "up", "down", "grid"), [(64, 3.0, -24.0, (0.4, 1.0)), (64, 21.6, -21.6, (0.4, 1.0))])
def test_sensors_of_64_beams_use_the_grid_of_the_paper(rows, up, down, grid):
    projection = SphericalProjection(rows, 720, up, down)
    assert (map_voxel_m(projection), query_voxel_m(projection)) == grid


@pytest.mark.parametrize(("rows", "up", "down"), [(32, 11.3, -31.3), (16, 16.0, -16.0)])
def test_beams_far_apart_share_wider_voxels_and_every_point_of_the_map_is_registered(rows, up, down):
    projection = SphericalProjection(rows, 720, up, down)
    assert 0.4 < map_voxel_m(projection) <= query_voxel_m(projection) <= 1.2


@pytest.mark.parametrize("sampling", [GridSampling(), ImageSampling(IMAGE), ImageSampling(IMAGE, max_queries=100)])
def test_queries_are_distinct_points_of_the_map(points, sampling):
    sampled = sampling.sample(points)
    queries = set(sampled.query_index.tolist())
    assert len(queries) == len(sampled.query_index) > 0
    assert queries <= set(sampled.map_index.tolist())


def test_the_image_holds_the_nearest_point_of_each_pixel(points):
    sampled = ImageSampling(IMAGE).sample(points)
    nearest = IMAGE.nearest_points(points)
    assert torch.equal(sampled.map_index, nearest[nearest >= 0])


def test_queries_are_as_many_as_asked_for_and_spread_over_the_image(points):
    sampled = ImageSampling(IMAGE, max_queries=2000).sample(points)
    assert len(sampled.query_index) == 2000
    pixel = IMAGE.pixel_index(points[sampled.query_index])
    all_pixels = IMAGE.pixel_index(points[sampled.map_index])
    for part, parts in ((lambda p: p // 720, 64), (lambda p: p % 720 // 45, 16)):
        share = part(pixel).bincount(minlength=parts) / 2000
        expected = part(all_pixels).bincount(minlength=parts) / len(all_pixels)
        assert (share - expected).abs().max() < 0.01


@pytest.mark.parametrize("sampling", [GridSampling(), ImageSampling(IMAGE)])
@pytest.mark.parametrize("count", [0, 1])
def test_tiny_scans_are_sampled(sampling, count):
    sampled = sampling.sample(torch.tensor([[10.0, 2.0, -1.0]]).expand(count, 3))
    assert len(sampled.map_index) == len(sampled.query_index) == count
