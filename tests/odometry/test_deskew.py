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
from tests.odometry.odometries import ASSOCIATIONS, build, kd_at_least, motion_errors, poses, run, scans_of, street

MOTION = se3.exp(torch.tensor([1.3, 0.1, -0.05, 0.01, -0.02, 0.09], dtype=torch.float64))
QUIET = Sensor("quiet", tuple(float(e) for e in range(10, -20, -2)), 256, range_noise=0.0, drop_out=0.0, reach=math.inf)


def slow_deskew(points: Tensor, times: Tensor, motion_per_period: Tensor) -> Tensor:
    """Point by point: where the sensor was at its instant, as a share of the motion."""
    twist = se3.log(motion_per_period)
    moved = [
        se3.transform(se3.exp(t * twist), p[None].double())[0] for p, t in zip(points, times.double(), strict=True)
    ]
    return torch.stack(moved)


@pytest.mark.parametrize("interval", [(-0.5, 0.5), (0.0, 1.0), (-1.0, 0.0)])
def test_agrees_with_the_motion_of_each_point(interval):
    generator = torch.Generator().manual_seed(0)
    points = 20 * torch.randn(500, 3, generator=generator)
    times = torch.empty(500).uniform_(*interval, generator=generator)
    expected = slow_deskew(points, times, MOTION)
    assert (deskew(points, times, MOTION).double() - expected).norm(dim=1).max() < 0.012


def test_a_distorted_scan_becomes_the_one_taken_at_an_instant():
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


def test_without_times_or_points_or_motion_nothing_changes():
    points = torch.randn(50, 3, generator=torch.Generator().manual_seed(0))
    assert deskew(points, None, MOTION) is points
    assert deskew(points[:0], torch.zeros(0), MOTION).shape == (0, 3)
    torch.testing.assert_close(deskew(points, torch.rand(50), se3.identity()), points)


def test_points_of_one_instant_move_together():
    points = torch.randn(50, 3, generator=torch.Generator().manual_seed(0))
    half = se3.exp(0.5 * se3.log(MOTION))
    torch.testing.assert_close(deskew(points, torch.full((50,), 0.5), MOTION), se3.transform(half, points))


@pytest.mark.slow
@pytest.mark.parametrize("world", ["highway", "segway"])
@pytest.mark.parametrize("association", ASSOCIATIONS)
def test_deskewing_lowers_the_error_at_high_speed_and_when_the_sensor_swings(world, association):
    """On the Segway constant velocity alone gains nothing: no scan moves as the one before it."""
    drive = Drive(world, seed=7, frames=40, motion_distortion=True)
    scans = list(drive)
    projection = "hdl64" if world == "highway" else "hdl32_inverted"
    with_times, without = (build(f"cv+{association}_f2m", projection=projection) for _ in range(2))
    deskewed = [with_times.register_scan(scan.points, scan.times) for scan in scans]
    skewed = run(without, [scan.points for scan in scans])
    errors, skewed_errors = (motion_errors(poses(frames), drive.T_world_lidar) for frames in (deskewed, skewed))
    assert errors[0].mean() < 0.8 * skewed_errors[0].mean()
    assert errors[1].mean() < 0.9 * skewed_errors[1].mean()
    assert ape_rmse(poses(deskewed), drive.T_world_lidar) < 0.5 * ape_rmse(poses(skewed), drive.T_world_lidar)


@kd_at_least
def test_scans_that_were_compensated_unlike_each_other_are_bent(association):
    """Every second one is skewed by 9 cm, as in KITTI 04, and by 0.2 deg."""
    drive, skew = street(), torch.tensor([0.09, 0.02, 0, 0, -0.003, 0.003], dtype=torch.float64)
    scans = [
        deskew(points, torch.atan2(points[:, 1], points[:, 0]) / (-2 * math.pi), se3.exp(-skew * (i % 2)))
        for i, points in enumerate(scans_of(drive))
    ]
    name = f"{association}_f2m"
    elastic = run(build(f"cv+{name}"), scans)
    rigid = run(build(f"cv+{name}", f"odometry.{name}.registration.elasticity=null"), scans)
    error, rigid_error = (motion_errors(poses(f), drive.T_world_lidar)[0].mean() for f in (elastic, rigid))
    assert error < 0.8 * rigid_error
    sizes = [frame.health.skew_m for frame in elastic[2:]]
    assert sum(sizes[1::2]) > 1.5 * sum(sizes[::2])  # bent are those that are skewed
    assert all(frame.health.skew_m == frame.health.skew_deg == 0 for frame in rigid[1:])
