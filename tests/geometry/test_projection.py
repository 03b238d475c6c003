import math

import pytest
import torch

from lidarlearn.geometry.projection import SphericalProjection, activated
from tests.gpu import on_gpu

HDL64 = SphericalProjection()
SMALL = SphericalProjection(height=6, width=10, fov_up_deg=30.0, fov_down_deg=-30.0)
SENSORS = [HDL64, SMALL, SphericalProjection(16, 720, 16.0, -16.0), SphericalProjection(32, 1024, 31.3, -11.3)]


def random_points(n: int, seed: int = 0, scale: float = 10.0) -> torch.Tensor:
    return scale * torch.randn(n, 3, generator=torch.Generator().manual_seed(seed))


def from_angles(azimuth_deg, elevation_deg, distance=1.0) -> torch.Tensor:
    a, e = (torch.as_tensor(x, dtype=torch.float64).deg2rad() for x in (azimuth_deg, elevation_deg))
    a, e = torch.broadcast_tensors(a, e)
    return (torch.stack([e.cos() * a.cos(), e.cos() * a.sin(), e.sin()], dim=-1) * distance).float()


def slow_nearest(projection: SphericalProjection, points: torch.Tensor) -> torch.Tensor:
    """The formulas of the projection, point by point; the first of equally near points wins."""
    index = torch.full((projection.height, projection.width), -1)
    nearest = torch.full((projection.height, projection.width), math.inf)
    up, down = math.radians(projection.fov_up_deg), math.radians(projection.fov_down_deg)
    for i, point in enumerate(points.double()):
        x, y, z = point.tolist()
        r = point.float().norm()
        if r == 0:
            continue
        column = math.floor((1 - math.atan2(y, x) / math.pi) / 2 * projection.width) % projection.width
        row = math.floor((up - math.asin(z / math.sqrt(x * x + y * y + z * z))) / (up - down) * projection.height)
        if 0 <= row < projection.height and r < nearest[row, column]:
            index[row, column], nearest[row, column] = i, r
    return index


@pytest.mark.parametrize("projection", SENSORS)
def test_projection_equals_formulas(projection):
    points = random_points(3000)
    points[:, 2] *= 0.3
    assert torch.equal(projection.nearest_points(points), slow_nearest(projection, points))


def test_forward_is_middle_column_and_left_comes_before():
    column = SMALL.pixel_index(from_angles([90.0, 0.0, -90.0], -1.0)) % SMALL.width
    assert column.tolist() == [2, 5, 7]


def test_columns_wrap_behind_sensor():
    behind = from_angles([180.0, 180 - 1e-3, -180 + 1e-3, -180.0], -1.0)
    column = SMALL.pixel_index(behind) % SMALL.width
    assert column[1] == 0 and column[2] == SMALL.width - 1
    assert all(c in (0, SMALL.width - 1) for c in column.tolist())
    exactly = torch.tensor([[-1.0, 0.0, 0.0], [-1.0, -0.0, 0.0]])
    assert (SMALL.pixel_index(exactly) % SMALL.width == 0).all()


def test_points_out_of_view_or_at_origin_have_no_pixel():
    outside = torch.cat([from_angles(0.0, [30.1, -30.1, 89.9, -90.0]), torch.zeros(1, 3)])
    assert (SMALL.pixel_index(outside) == -1).all()
    assert not activated(SMALL.vertex_map(outside)).any()


def test_points_on_vertical_axis_have_pixel_if_in_view():
    full = SphericalProjection(4, 8, 90.0, -91.0)
    assert (full.pixel_index(torch.tensor([[0.0, 0.0, -2.0], [0.0, 0.0, 1.9]])) >= 0).all()


def test_nearest_point_wins_pixel_in_any_order():
    ray = from_angles(40.0, -3.0)
    points = torch.cat([5 * ray[None], 2 * ray[None], 9 * ray[None]])
    for order in ([0, 1, 2], [2, 1, 0], [1, 0, 2]):
        image = HDL64.vertex_map(points[order])
        assert torch.equal(image[:, activated(image)].T, points[1:2])


def test_first_of_equally_near_points_wins():
    base = torch.tensor([[3.0, 4.0, 0.0]])
    points = torch.cat([2 * base, base, base, base])
    assert HDL64.nearest_points(points).max() == 1
    shuffled = HDL64.nearest_points(points[[1, 0, 2, 3]])
    assert shuffled.max() == 0


def test_ties_are_deterministic():
    points = random_points(200).repeat(20, 1)
    images = [HDL64.nearest_points(points) for _ in range(3)]
    assert all(torch.equal(image, images[0]) for image in images) and images[0].max() < 200


@pytest.mark.parametrize("projection", SENSORS)
def test_vertex_map_projects_onto_itself(projection):
    image = projection.vertex_map(random_points(4000))
    assert activated(image).sum() > 50
    assert torch.equal(projection.vertex_map(image[:, activated(image)].T), image)


@pytest.mark.parametrize("projection", SENSORS)
def test_pixel_centres_project_to_their_pixels(projection):
    row, column = torch.meshgrid(torch.arange(projection.height), torch.arange(projection.width), indexing="ij")
    span = projection.fov_up_deg - projection.fov_down_deg
    elevation = projection.fov_up_deg - (row + 0.5) / projection.height * span
    centres = from_angles(180 - (column + 0.5) / projection.width * 360, elevation).reshape(-1, 3)
    assert projection.pixel_index(centres).tolist() == list(range(projection.pixels))


def test_batch_equals_single_scans():
    points = torch.stack([random_points(500, seed) for seed in range(6)]).view(2, 3, 500, 3)
    images = HDL64.vertex_map(points)
    assert images.shape == (2, 3, 3, 64, 720)
    assert torch.equal(images[1, 2], HDL64.vertex_map(points[1, 2]))


def test_empty_scan_gives_empty_image():
    assert not HDL64.vertex_map(torch.zeros(0, 3)).any()
    assert HDL64.vertex_map(torch.zeros(2, 0, 3)).shape == (2, 3, 64, 720)
    assert (HDL64.nearest_points(torch.zeros(0, 3)) == -1).all()


def test_gradients_reach_nearest_points_only():
    points = random_points(400).double().requires_grad_()
    weights = torch.randn(3, 64, 720, dtype=torch.float64, generator=torch.Generator().manual_seed(1))
    (HDL64.vertex_map(points) * weights).sum().backward()
    index = HDL64.nearest_points(points)
    expected = torch.zeros_like(points)
    expected[index[index >= 0]] = weights[:, index >= 0].T
    torch.testing.assert_close(points.grad, expected)


def test_gradcheck_of_vertex_map():
    points = from_angles([10.0, 100.0, -95.0, 10.0], [-2.0, -5.0, 1.0, -2.0], torch.tensor([[4.0], [7], [9], [8]]))
    assert torch.autograd.gradcheck(SMALL.vertex_map, (points.double().requires_grad_(),))


@pytest.mark.parametrize("settings", [(0, 720, 3.0, -24.0), (64, 0, 3.0, -24.0), (64, 720, -24.0, 3.0)])
def test_impossible_images_are_refused(settings):
    with pytest.raises(ValueError, match="height, width >= 1 and fov_up_deg > fov_down_deg"):
        SphericalProjection(*settings)


@on_gpu
def test_gpu_finds_same_nearest_points():
    """But for points on the border of a pixel, which may round to either side."""
    points = random_points(100_000, scale=30.0)
    here, there = HDL64.nearest_points(points), HDL64.nearest_points(points.cuda()).cpu()
    assert (here == there).float().mean() > 0.999
    assert torch.equal(there, HDL64.nearest_points(points.cuda()).cpu())
