import pytest
import torch
from torch import Tensor

from lidarlearn.geometry.normals import fit_planes
from lidarlearn.geometry.voxels import grid_sample, voxel_cells
from lidarlearn.registration.association.voxel_map import VoxelMap
from tests.registration import maps

VOXEL = 0.4
CPU = torch.device("cpu")


def scans(count: int, name: str = "street") -> list[Tensor]:
    """Scans in the world, thinned as an odometry does."""
    drive = maps.drive(name)
    world = []
    for i in range(count):
        points = drive.scan(i).points
        points = points[grid_sample(points, VOXEL)]
        world.append(points + drive.T_world_lidar[i, :3, 3].float())
    return world


def wandering(count: int, n: int = 300, seed: int = 0) -> list[Tensor]:
    """Small scans of a patch of rough ground that moves along x."""
    generator = torch.Generator().manual_seed(seed)
    world = []
    for i in range(count):
        points = torch.rand(n, 3, generator=generator) * torch.tensor([8.0, 8.0, 0.5])
        world.append(points + torch.tensor([0.3 * i, 0.0, 0.0]))
    return world


def slow_normal(points: Tensor, index: int) -> Tensor | None:
    """From scratch: an eigenvector of the covariance of a point's 3x3x3 voxels; None where there is no plane."""
    cells = voxel_cells(points, VOXEL)
    near = points[((cells - cells[index]).abs() <= 1).all(dim=1)].double()
    if len(near) < 6:
        return None
    centred = near - near.mean(dim=0)
    values, vectors = torch.linalg.eigh(centred.T @ centred / len(near))
    is_plane = values[1] >= (0.15 * VOXEL) ** 2 and values[0] <= 0.25 * values[1]
    return vectors[:, 0] if is_plane else None


def test_map_has_one_point_per_voxel():
    cloud = VoxelMap(VOXEL, CPU)
    for points in scans(4):
        cloud.insert(points, frames=30)
    cells = voxel_cells(cloud.points, VOXEL)
    assert len(cells.unique(dim=0)) == len(cells) > 5000


def test_every_occupied_voxel_keeps_a_measured_point():
    cloud, world = VoxelMap(VOXEL, CPU), scans(3)
    for points in world:
        cloud.insert(points, frames=30)
    everything = torch.cat(world)
    assert set(map(tuple, cloud.points.tolist())) <= set(map(tuple, everything.tolist()))
    assert len(voxel_cells(everything, VOXEL).unique(dim=0)) == len(cloud.points)
    index = cloud.lookup(voxel_cells(everything, VOXEL))
    assert (index >= 0).all()
    assert torch.equal(voxel_cells(cloud.points[index], VOXEL), voxel_cells(everything, VOXEL))


def test_window_forgets_oldest_scans():
    cloud, world = VoxelMap(VOXEL, CPU), [torch.tensor([[10.0 * i, 0.0, 0.0]]) for i in range(12)]
    for i, points in enumerate(world):
        cloud.insert(points, frames=4)
        expected = torch.cat(world[max(0, i - 3) : i + 1])
        assert torch.equal(cloud.points, expected)
        found = cloud.lookup(voxel_cells(torch.cat(world[: i + 1]), VOXEL)) >= 0
        assert found.tolist() == [k > i - 4 for k in range(i + 1)]


def test_forgotten_voxel_is_mapped_again():
    cloud, here, there = VoxelMap(VOXEL, CPU), torch.tensor([[0.1, 0.1, 0.1]]), torch.tensor([[50.0, 0, 0]])
    cloud.insert(here, frames=2)
    cloud.insert(here + 0.05, frames=2)  # its voxel is taken
    assert torch.equal(cloud.points, here)
    cloud.insert(there, frames=2)
    assert torch.equal(cloud.points, there)
    cloud.insert(here + 0.05, frames=2)
    assert torch.equal(cloud.points, torch.cat([there, here + 0.05]))


def test_empty_scans_count_as_scans():
    cloud = VoxelMap(VOXEL, CPU)
    cloud.insert(torch.zeros(1, 3), frames=2)
    cloud.insert(torch.zeros(0, 3), frames=2)
    assert len(cloud.points) == 1
    cloud.insert(torch.zeros(0, 3), frames=2)
    assert len(cloud.points) == 0 and len(cloud.normals) == 0


@pytest.mark.parametrize("name", ["street", "room", "wandering"])
def test_incremental_normals_equal_those_from_scratch(name):
    cloud = VoxelMap(VOXEL, CPU)
    for points in wandering(20) if name == "wandering" else scans(4, name):
        cloud.insert(points, frames=100)
    chosen = range(0, len(cloud.points), max(len(cloud.points) // 200, 1))
    compared = 0
    for i in chosen:
        expected, actual = slow_normal(cloud.points, i), cloud.normals[i].double()
        if expected is None:
            assert not actual.any()
        else:
            compared += 1
            assert (actual @ expected).abs() > 0.999 or (not actual.any() and _is_border(cloud.points, i))
    assert compared > 50


def _is_border(points: Tensor, index: int) -> bool:
    """Whether rounding may decide if there is a plane."""
    cells = voxel_cells(points, VOXEL)
    near = points[((cells - cells[index]).abs() <= 1).all(dim=1)].double()
    values = torch.linalg.eigvalsh((near - near.mean(dim=0)).T @ (near - near.mean(dim=0)) / len(near))
    return bool((values[1] / (0.15 * VOXEL) ** 2 - 1).abs() < 1e-3 or (values[0] / (0.25 * values[1]) - 1).abs() < 1e-3)


def test_moving_buffers_keeps_points_normals_and_lookup():
    """Small buffers are moved with every other scan, large ones never."""
    small, large, world = VoxelMap(VOXEL, CPU), VoxelMap(VOXEL, CPU), wandering(30)
    small._reserve(64)
    for points in world:
        small.insert(points, frames=5)
        large.insert(points, frames=5)
        assert torch.equal(small.points, large.points)
        torch.testing.assert_close(small.normals, large.normals)
        cells = voxel_cells(points, VOXEL)
        assert torch.equal(small.lookup(cells), large.lookup(cells))
    assert len(small._cells) < len(large._cells)


def test_buffers_are_bounded_by_window():
    cloud = VoxelMap(VOXEL, CPU)
    cloud._reserve(64)
    most_living = 0
    for points in wandering(100, n=120):
        cloud.insert(points, frames=5)
        most_living = max(most_living, len(cloud.points))
    assert len(cloud._cells) <= 2 * (most_living + 120)


def test_normals_of_flat_floor_are_vertical():
    grid = torch.arange(-20, 20) * 0.3
    floor = torch.cartesian_prod(grid, grid, torch.tensor([-1.7]))
    cloud = VoxelMap(VOXEL, CPU)
    cloud.insert(floor, frames=1)
    level = cloud.normals[:, 2].abs()
    assert (level > 0.9999).float().mean() > 0.95
    assert ((level > 0.9999) | (level == 0)).all()


def test_line_of_points_has_no_normals():
    x = torch.arange(0, 20, 0.2)
    line = torch.stack([x, torch.zeros_like(x), 0.01 * torch.sin(20 * x)], dim=1)
    cloud = VoxelMap(VOXEL, CPU)
    cloud.insert(line, frames=1)
    assert not cloud.normals.any()


def test_normals_are_accurate_far_from_origin():
    world, far = wandering(5), torch.tensor([8192.0, -4096.0, 0.0])
    near_cloud, far_cloud = VoxelMap(0.5, CPU), VoxelMap(0.5, CPU)  # shifts by whole voxels
    for points in world:
        points = (points * 64).round() / 64  # a grid that both places can represent
        near_cloud.insert(points, frames=30)
        far_cloud.insert(points + far, frames=30)
    torch.testing.assert_close(far_cloud.points - far, near_cloud.points)
    torch.testing.assert_close(far_cloud.normals, near_cloud.normals, rtol=0, atol=1e-4)


def test_plane_normal_is_direction_of_least_variance():
    points = torch.randn(50, 3, generator=torch.Generator().manual_seed(0)).double() * torch.tensor([1.0, 0.7, 0.02])
    centred = points - points.mean(dim=0)
    covariance = (centred.T @ centred / 50).flatten()[[0, 1, 2, 4, 5, 8]]
    assert fit_planes(covariance).normals[2].abs() > 0.99
