"""Sensor trajectories in continuous time, from a planar motion on the ground or from given poses."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float
from scipy.interpolate import CubicSpline
from scipy.ndimage import gaussian_filter1d
from scipy.spatial.transform import Rotation, RotationSpline

from lidarlearn.data.errors import DamagedFileError
from lidarlearn.data.pose_files import read_kitti_poses
from lidarlearn.simulation.terrain import Terrain

# Axes of KITTI's left camera (x right, y down, z forward) in the LiDAR's (x forward, y left, z up).
_R_LIDAR_CAMERA = np.array([[0.0, 0, 1], [-1, 0, 0], [0, -1, 0]])


@dataclass(frozen=True)
class PlanarMotion:
    """The motion of a vehicle on a map.

    Args:
        times: times of the samples, evenly spaced [s].
        xy: position of the reference point of the vehicle [m].
        heading: direction of the vehicle, without jumps of 2 pi [rad].
        speed: speed along the heading [m/s].
        sway: pitch in addition to that due to ground and acceleration, positive with the nose down [rad].
        track: the path, from well before the first position to well beyond the last [m].
    """

    times: Float[np.ndarray, "n"]
    xy: Float[np.ndarray, "n 2"]
    heading: Float[np.ndarray, "n"]
    speed: Float[np.ndarray, "n"]
    sway: Float[np.ndarray, "n"]
    track: Float[np.ndarray, "m 2"]


@dataclass(frozen=True)
class Vehicle:
    """The vehicle that carries the sensor.

    Args:
        sensor_height: height of the sensor above the ground [m].
        sensor_forward: distance of the sensor in front of the reference point on the rear axle [m].
        wheelbase: distance between the axles [m].
        gauge: distance between left and right wheels [m].
        squat: pitch with the nose up, per forward acceleration [rad per m/s^2].
        lean: outward roll, per lateral acceleration [rad per m/s^2].
    """

    sensor_height: float = 1.73
    sensor_forward: float = 0.8
    wheelbase: float = 2.7
    gauge: float = 1.6
    squat: float = 0.006
    lean: float = 0.006


class Trajectory:
    """Sensor poses at any time, smooth in between.

    Args:
        times: times of the given poses, increasing [s].
        poses: `T_world_lidar` at these times.
    """

    def __init__(self, times: Float[np.ndarray, "n"], poses: Float[np.ndarray, "n 4 4"]) -> None:
        self.times, self.poses = times, poses
        self._position = CubicSpline(times, poses[:, :3, 3])
        self._rotation = RotationSpline(times, Rotation.from_matrix(poses[:, :3, :3]))

    def at(self, times: Float[np.ndarray, "k"]) -> Float[np.ndarray, "k 4 4"]:
        """`T_world_lidar` at any times, up to one period of the sensor before or after those of the given poses."""
        poses = np.tile(np.eye(4), (len(times), 1, 1))
        poses[:, :3, :3] = self._rotation(times).as_matrix()
        poses[:, :3, 3] = self._position(times)
        return poses


def on_ground(motion: PlanarMotion, terrain: Terrain, vehicle: Vehicle) -> Trajectory:
    """The trajectory of the sensor on a vehicle whose pitch and roll follow the ground below its four wheels.

    Acceleration tilts it further. Nothing jitters: ground and motion are smooth at the scale of the vehicle.
    """
    forward = np.stack([np.cos(motion.heading), np.sin(motion.heading)], axis=-1)
    left = np.stack([-forward[:, 1], forward[:, 0]], axis=-1)
    wheels = {
        (i, j): terrain.height(motion.xy + i * vehicle.wheelbase * forward + j * vehicle.gauge / 2 * left)
        for i in (0, 1)
        for j in (-1, 1)
    }
    rear, front = (wheels[0, -1] + wheels[0, 1]) / 2, (wheels[1, -1] + wheels[1, 1]) / 2
    rise_left = (wheels[0, 1] + wheels[1, 1] - wheels[0, -1] - wheels[1, -1]) / 2
    step = motion.times[1] - motion.times[0]
    acceleration = gaussian_filter1d(np.gradient(motion.speed, step), 0.3 / step, mode="nearest")
    lateral = gaussian_filter1d(motion.speed * np.gradient(motion.heading, step), 0.3 / step, mode="nearest")
    pitch = -np.arctan2(front - rear, vehicle.wheelbase) - vehicle.squat * acceleration + motion.sway
    roll = np.arctan2(rise_left, vehicle.gauge) + vehicle.lean * lateral
    poses = np.tile(np.eye(4), (len(rear), 1, 1))
    poses[:, :3, :3] = Rotation.from_euler("ZYX", np.stack([motion.heading, pitch, roll], axis=-1)).as_matrix()
    mount = np.array([vehicle.sensor_forward, 0, vehicle.sensor_height])
    poses[:, :3, 3] = np.column_stack([motion.xy, rear]) + poses[:, :3, :3] @ mount
    return Trajectory(motion.times, poses)


def read_poses(path: Path, camera: bool) -> Float[np.ndarray, "n 4 4"]:
    """`T_world_lidar` from a file in KITTI's format (12 numbers a row).

    Args:
        path: the file.
        camera: whether the poses are those of KITTI's left camera, as published for the odometry benchmark. Their axes
            are rotated to the LiDAR's; the offset between the two sensors is neglected.

    Raises:
        DamagedFileError: the file is missing or does not hold two rows of 12 finite numbers.
    """
    poses = read_kitti_poses(path).numpy()
    if len(poses) < 2:
        raise DamagedFileError(path, "a single pose, at least two are needed", "data.pose_file to a drive's poses")
    if camera:
        C = np.eye(4)
        C[:3, :3] = _R_LIDAR_CAMERA
        poses = C @ poses @ C.T
    # The nearest rotations, because the file holds only a few digits.
    poses[:, :3, :3] = Rotation.from_matrix(poses[:, :3, :3]).as_matrix()
    return poses


def arc_length(path: Float[np.ndarray, "n d"]) -> Float[np.ndarray, "n"]:
    """Length of the path up to each of its points [m]."""
    return np.concatenate([[0], np.cumsum(np.linalg.norm(np.diff(path, axis=0), axis=1))])


def extended(path: Float[np.ndarray, "n d"], length: float) -> Float[np.ndarray, "m d"]:
    """A path resampled at 1 m and extended straight ahead by `length` [m] at either end."""
    s = arc_length(path)
    grid = np.arange(0, max(s[-1], 1.0), 1.0)
    thinned = np.column_stack([np.interp(grid, s, path[:, k]) for k in range(path.shape[1])])
    if len(thinned) < 3 or s[-1] < 3:
        thinned = path[:1] + np.arange(3.0)[:, None] * np.eye(path.shape[1])[0]
    ahead = np.arange(1.0, length)[:, None]
    start, end = thinned[0] - thinned[2], thinned[-1] - thinned[-3]
    before = thinned[0] + ahead[::-1] * start / np.linalg.norm(start)
    after = thinned[-1] + ahead * end / np.linalg.norm(end)
    return np.concatenate([before, thinned, after])
