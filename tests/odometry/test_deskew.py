import math

import pytest
import torch
from torch import Tensor

from lidarlearn.geometry import se3
from lidarlearn.metrics.absolute import ape_rmse
from lidarlearn.odometry.deskew import deskew
from lidarlearn.simulation.drive import Drive
from lidarlearn.simulation.sensors import Sensor
from tests import scenes
from tests.odometry.odometries import (
    ASSOCIATIONS,
    build,
    kd_fast_others_slow,
    motion_errors,
    poses,
    run,
    run_with_times,
    street,
    street_scans,
)

MOTION = se3.exp(torch.tensor([1.3, 0.1, -0.05, 0.01, -0.02, 0.09], dtype=torch.float64))
QUIET = Sensor("quiet", tuple(float(e) for e in range(10, -20, -2)), 256, range_noise=0.0, drop_out=0.0, reach=math.inf)


def slow_deskew(points: Tensor, times: Tensor, motion_per_period: Tensor) -> Tensor:
    """Each point by its own share of the motion."""
    twist = se3.log(motion_per_period)
    moved = (se3.transform(se3.exp(t * twist), p[None]) for p, t in zip(points.double(), times.double(), strict=True))
    return torch.cat(list(moved))


@pytest.mark.parametrize("interval", [(-0.5, 0.5), (0.0, 1.0), (-1.0, 0.0)])
def test_deskew_moves_each_point_by_its_share(interval):
    generator = torch.Generator().manual_seed(0)
    points = 20 * torch.randn(200, 3, generator=generator)
    times = torch.empty(200).uniform_(*interval, generator=generator)
    expected = slow_deskew(points, times, MOTION)
    assert (deskew(points, times, MOTION).double() - expected).norm(dim=1).max() < 0.012


def test_deskew_restores_surfaces_of_distorted_scan():
    """Every point lies on the room's floor, ceiling or walls again."""
    path = scenes.straight_path(7, 0.8, start=-3.0, yaw_step=0.08)
    drive = Drive(scenes.room(height=4.0), poses=path, sensor=QUIET, motion_distortion=True)
    scan, T_world_lidar = drive.scan(3), torch.from_numpy(path[3])
    motion = se3.inverse(torch.from_numpy(path[2])) @ T_world_lidar

    def off_the_shell(points: Tensor) -> Tensor:
        x, y, z = se3.transform(T_world_lidar, points.double()).unbind(-1)
        shell = torch.stack([(x.abs() - 10).abs(), (y.abs() - 7).abs(), z.abs(), (z - 4).abs()]).amin(0)
        return shell[(x.abs() > 7.5) | (y.abs() > 6)]  # where there is no furniture

    assert off_the_shell(scan.points).quantile(0.9) > 0.2
    assert off_the_shell(deskew(scan.points, scan.times, motion)).quantile(0.99) < 0.02


def test_deskew_without_times_points_or_motion_changes_nothing():
    points = torch.randn(50, 3, generator=torch.Generator().manual_seed(0))
    assert deskew(points, None, MOTION) is points
    assert deskew(points[:0], torch.zeros(0), MOTION).shape == (0, 3)
    torch.testing.assert_close(deskew(points, torch.rand(50), se3.identity()), points)


def test_deskew_moves_points_of_equal_time_rigidly():
    points = torch.randn(50, 3, generator=torch.Generator().manual_seed(0))
    half = se3.exp(0.5 * se3.log(MOTION))
    torch.testing.assert_close(deskew(points, torch.full((50,), 0.5), MOTION), se3.transform(half, points))


@pytest.mark.slow
@pytest.mark.parametrize("world", ["highway", "segway"])
@pytest.mark.parametrize("association", ASSOCIATIONS)
def test_deskewing_lowers_errors_on_motorway_and_segway(world, association):
    """On the Segway constant velocity alone gains nothing: no scan moves as the one before it."""
    drive = Drive(world, seed=7, frames=40, motion_distortion=True)
    scans = list(drive)
    projection = "hdl64" if world == "highway" else "hdl32_inverted"
    with_times, without = (build(f"cv+{association}_f2m", projection=projection) for _ in range(2))
    deskewed = run_with_times(with_times, scans)
    skewed = run(without, [scan.points for scan in scans])
    errors, skewed_errors = (motion_errors(poses(frames), drive.T_world_lidar) for frames in (deskewed, skewed))
    assert errors[0].mean() < 0.8 * skewed_errors[0].mean()
    assert errors[1].mean() < 0.9 * skewed_errors[1].mean()
    assert ape_rmse(poses(deskewed), drive.T_world_lidar) < 0.5 * ape_rmse(poses(skewed), drive.T_world_lidar)


@kd_fast_others_slow
def test_elasticity_lowers_errors_of_unevenly_deskewed_scans(association):
    """Every second one is skewed by 9 cm, as in KITTI 04, and by 0.2 deg."""
    T_world_lidar = street().T_world_lidar[:8]
    skew = torch.tensor([0.09, 0.02, 0, 0, -0.003, 0.003], dtype=torch.float64)
    scans = [
        deskew(points, torch.atan2(points[:, 1], points[:, 0]) / (-2 * math.pi), se3.exp(-skew * (i % 2)))
        for i, points in enumerate(street_scans()[:8])
    ]
    name = f"{association}_f2m"
    elastic = run(build(f"cv+{name}"), scans)
    rigid = run(build(f"cv+{name}", f"odometry.{name}.registration.elasticity=null"), scans)
    error, rigid_error = (motion_errors(poses(f), T_world_lidar)[0].mean() for f in (elastic, rigid))
    assert error < 0.8 * rigid_error
    sizes = [frame.health.skew_m for frame in elastic[2:]]
    assert sum(sizes[1::2]) > 1.5 * sum(sizes[::2])
    assert all(frame.health.skew_m == frame.health.skew_deg == 0 for frame in rigid[1:])
