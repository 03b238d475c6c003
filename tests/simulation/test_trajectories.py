import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from lidarlearn.errors import UserError
from lidarlearn.simulation import motions
from lidarlearn.simulation.terrain import GroundBelow, Hills, Terrain
from lidarlearn.simulation.trajectories import PlanarMotion, Vehicle, extended, on_ground, read_poses


def _drive(seed, style=motions.URBAN, speed=None, duration=25.0):
    return motions.drive(np.random.default_rng(seed), style, 0.0, duration, speed)


@pytest.mark.parametrize("seed", range(6))
def test_urban_motion_is_smooth_within_limits_of_cars(seed):
    motion = _drive(seed)
    speed = np.linalg.norm(np.diff(motion.xy, axis=0), axis=1) / 0.05
    acceleration = np.diff(motion.speed) / 0.05
    yaw_rate = np.diff(motion.heading) / 0.05
    assert speed == pytest.approx((motion.speed[1:] + motion.speed[:-1]) / 2, abs=0.05)
    assert np.abs(acceleration).max() < 3.5
    assert np.abs(np.diff(acceleration)).max() / 0.05 < 15  # jerk [m/s^3]
    assert np.abs(np.degrees(yaw_rate)).max() < 45
    assert np.abs(np.degrees(np.diff(yaw_rate))).max() / 0.05 < 120


@pytest.mark.parametrize("style", ["URBAN", "HIGHWAY", "CAMPUS"])
def test_speed_is_positive_at_start(style):
    assert min(_drive(seed, getattr(motions, style)).speed[0] for seed in range(20)) > 2.0


def test_heading_follows_course():
    motion = _drive(1)
    step = np.diff(motion.xy, axis=0)
    moving = np.linalg.norm(step, axis=1) > 0.05
    course = np.unwrap(np.arctan2(step[:, 1], step[:, 0]))
    middle = (motion.heading[1:] + motion.heading[:-1]) / 2
    assert np.abs(np.angle(np.exp(1j * (course - middle))))[moving].max() < 0.01


@pytest.mark.parametrize("speed", [3.0, 12.0, 30.0])
def test_constant_speed_holds_and_limits_lateral_acceleration(speed):
    motion = _drive(2, speed=speed)
    step = np.linalg.norm(np.diff(motion.xy, axis=0), axis=1)
    assert step == pytest.approx(np.full(len(step), speed * 0.05), rel=2e-3)
    lateral = speed * np.abs(np.diff(motion.heading)) / 0.05
    assert lateral.max() < 4.5


def test_speeds_are_similar_to_kitti():
    town = np.concatenate([_drive(seed).speed for seed in range(40)]) * 3.6
    highway = np.concatenate([_drive(seed, motions.HIGHWAY).speed for seed in range(40)]) * 3.6
    assert 22 < town.mean() < 50 and town.max() < 60
    assert 72 < highway.mean() < 85 and 95 < highway.max() < 112


def test_urban_motion_turns_left_and_right():
    rates = np.degrees(np.concatenate([np.diff(_drive(seed).heading) / 0.05 for seed in range(20)]))
    assert rates.min() < -25 and rates.max() > 25


def test_segway_is_slow_with_abrupt_turns_and_sway():
    runs = [motions.segway(np.random.default_rng(seed), 0.0, 30.0) for seed in range(6)]
    assert max(run.speed.max() for run in runs) <= 1.51 and min(run.speed.min() for run in runs) >= -1e-6
    assert max(np.abs(np.diff(run.heading)).max() / 0.05 for run in runs) > np.radians(60)
    assert all(np.ptp(np.degrees(run.sway)) > 4 for run in runs)


class _InclinedPlane(Terrain):
    def height(self, xy):
        return 0.1 * xy[..., 0] + 0.05 * xy[..., 1]


def test_sensor_is_perpendicular_to_inclined_plane():
    times = np.arange(0, 5, 0.05)
    xy = np.column_stack([10 * times, 0 * times])
    motion = PlanarMotion(times, xy, 0 * times, 0 * times + 10, 0 * times, xy)
    T = on_ground(motion, _InclinedPlane(), Vehicle(sensor_height=1.7, sensor_forward=0.0)).poses
    up = np.array([-0.1, -0.05, 1.0]) / np.linalg.norm([-0.1, -0.05, 1.0])
    assert T[50, :3, 2] == pytest.approx(up, abs=1e-3)
    height = (T[:, :3, 3] - np.column_stack([xy, _InclinedPlane().height(xy)])) @ up
    assert height == pytest.approx(np.full(len(times), 1.7), abs=0.01)


def test_trajectory_interpolates_poses_smoothly():
    trajectory = on_ground(_drive(3), Hills(np.random.default_rng(0), 2.0), Vehicle())
    assert trajectory.at(trajectory.times[::40]) == pytest.approx(trajectory.poses[::40], abs=1e-9)
    T = trajectory.at(np.arange(2.0, 20.0, 0.01))
    R = T[:, :3, :3]
    assert R @ R.transpose(0, 2, 1) == pytest.approx(np.tile(np.eye(3), (len(R), 1, 1)), abs=1e-9)
    acceleration = np.diff(T[:, :3, 3], n=2, axis=0) / 0.01**2
    assert np.linalg.norm(acceleration, axis=1).max() < 8
    rates = Rotation.from_matrix(R[:-1].transpose(0, 2, 1) @ R[1:]).as_rotvec() / 0.01
    assert np.degrees(np.abs(rates[:, :2])).max() < 15  # roll and pitch
    assert np.degrees(np.abs(np.diff(rates, axis=0))).max() / 0.01 < 150


def test_hills_have_given_slope():
    xy, half = np.random.default_rng(0).uniform(-3000, 3000, (10000, 2)), np.array([0.5, 0.0])
    slopes = [
        (hills.height(xy + half) - hills.height(xy - half)).std()
        for hills in (Hills(np.random.default_rng(seed), 2.0) for seed in range(30))
    ]
    assert np.degrees(np.arctan(np.mean(np.square(slopes)) ** 0.5)) == pytest.approx(2.0, rel=0.25)


def test_ground_below_path_keeps_heights():
    s = np.arange(0, 400, 1.0)
    points = np.column_stack([s, 30 * np.sin(s / 60), 5 * np.sin(s / 80)])
    assert np.abs(GroundBelow(points).height(points[:, :2]) - points[:, 2])[20:-20].max() < 0.1


def test_extended_path_continues_straight():
    line = extended(np.column_stack([np.arange(0, 10, 0.3), np.zeros(34)]), 50.0)
    assert line[:, 1] == pytest.approx(np.zeros(len(line)))
    assert line[0, 0] < -48 and line[-1, 0] > 55
    assert np.diff(line[:, 0]) == pytest.approx(np.ones(len(line) - 1))


def test_camera_poses_are_converted_to_lidar_axes(tmp_path):
    forward_2m = "1 0 0 0 0 1 0 0 0 0 1 {}\n"
    (tmp_path / "00.txt").write_text(forward_2m.format(0) + forward_2m.format(2))
    T = read_poses(tmp_path / "00.txt", camera=True)
    assert T[1, :3, 3] == pytest.approx([2, 0, 0])
    assert read_poses(tmp_path / "00.txt", camera=False)[1, :3, 3] == pytest.approx([0, 0, 2])


@pytest.mark.parametrize("content", ["", "1 2 3\n4 5 6\n", "a b\n", "1 0 0 0 0 1 0 0 0 0 1 nan\n" * 2])
def test_damaged_pose_file_error_names_file(tmp_path, content):
    (tmp_path / "bad.txt").write_text(content)
    with pytest.raises(UserError, match=r"bad\.txt"):
        read_poses(tmp_path / "bad.txt", camera=True)
