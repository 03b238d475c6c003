"""KITTI raw's files, and its time stamps, which KITTI-360 shares."""

from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation
from torch import Tensor

from lidarlearn.data.export.drives import (
    PERIOD_S,
    ground_truth_of,
    require_sweeps,
    scans_of,
    timestamps_of,
    write_shared,
)
from lidarlearn.data.export.kitti import write_velodyne_points
from lidarlearn.data.kitti_raw import KittiRaw
from lidarlearn.data.oxts import EARTH_RADIUS_M
from lidarlearn.data.sequence import Sequence
from lidarlearn.errors import UserError

_LEVER_ARM_M = (-0.81, 0.32, -0.80)  # of KITTI's GPS/IMU, in the LiDAR's frame
_START_DEG = (49.0, 8.4)  # latitude and longitude of Karlsruhe
_START_ALTITUDE_M = 115.0


def require_kitti_raw(drive: Sequence, target: KittiRaw, name: str) -> None:
    """Raise UserError unless azimuths tell the points' times, there are poses, and the name is a drive's."""
    require_sweeps(drive, target.title)
    ground_truth_of(drive, target.title)
    if not name.partition("_drive_")[2]:
        raise UserError(f"{target.title}: {name!r} does not name a drive.\n  change: a name like 2011_09_26_drive_0009")


def write_kitti_raw(drive: Sequence, target: KittiRaw, name: str) -> None:
    """Scans, start and end times, GPS/IMU packets at the middle of each sweep, and the calibration between the two.

    Of a packet, position, orientation and velocity are filled in; accelerations, rates and accuracies are zero.
    """
    T_world_lidar = ground_truth_of(drive, target.title)
    date = name.partition("_drive_")[0]
    folder = target.root / date / f"{name.removesuffix('_sync')}_sync"
    T_lidar_imu = torch.eye(4, dtype=torch.float64)
    T_lidar_imu[:3, 3] = torch.tensor(_LEVER_ARM_M)
    translation = " ".join(f"{value:.6e}" for value in T_lidar_imu[:3, 3].tolist())
    calibration = f"calib_time: 01-Jan-2011 00:00:00\nR: 1 0 0 0 1 0 0 0 1\nT: {translation}\n"
    write_shared(folder.parent / "calib_imu_to_velo.txt", calibration)
    for part in ("velodyne_points/data", "oxts/data"):
        (folder / part).mkdir(parents=True, exist_ok=True)
    for index, scan in enumerate(scans_of(drive, name)):
        write_velodyne_points(
            folder / "velodyne_points" / "data" / f"{index:010d}.bin", scan, target.beam_correction_deg
        )
    day, middles = np.datetime64(date.replace("_", "-"), "ns"), timestamps_of(drive)
    for suffix, offset in (("_start", -PERIOD_S / 2), ("", 0.0), ("_end", PERIOD_S / 2)):
        write_timestamps(folder / "velodyne_points" / f"timestamps{suffix}.txt", day, middles + offset)
    write_timestamps(folder / "oxts" / "timestamps.txt", day, middles)
    packets = _packets((T_world_lidar @ T_lidar_imu).numpy(), middles.numpy())
    for index, row in enumerate(packets):
        text = " ".join(f"{value:.14g}" for value in row)
        (folder / "oxts" / "data" / f"{index:010d}.txt").write_text(text + "\n", encoding="utf-8")


def write_timestamps(path: Path, day: np.datetime64, seconds: Float[Tensor, "n"]) -> None:
    """One date with nanoseconds a line.

    Args:
        path: of the file.
        day: to which the seconds are added, plus half a day: no recording begins at midnight.
        seconds: of each line.
    """
    stamps = day + np.timedelta64(12, "h") + np.round(seconds.numpy() * 1e9).astype("timedelta64[ns]")
    path.write_text("".join(f"{str(stamp).replace('T', ' ')}\n" for stamp in stamps), encoding="utf-8")


def _packets(T_world_imu: NDArray[np.float64], times: NDArray[np.float64]) -> NDArray[np.float64]:
    """30 numbers for each pose: see `dataformat.txt` of KITTI raw. The inverse of `oxts.read_oxts_poses`."""
    latitude_0, longitude_0 = np.radians(_START_DEG)
    scale = np.cos(latitude_0) * EARTH_RADIUS_M
    x, y, z = (T_world_imu[:, :3, 3] - T_world_imu[0, :3, 3]).T
    north_0 = np.log(np.tan(np.pi / 4 + latitude_0 / 2))
    latitude = 2 * np.arctan(np.exp(north_0 + y / scale)) - np.pi / 2
    yaw, pitch, roll = Rotation.from_matrix(T_world_imu[:, :3, :3]).as_euler("ZYX").T
    packets = np.zeros((len(times), 30))
    packets[:, :6] = np.stack(
        [np.degrees(latitude), np.degrees(longitude_0 + x / scale), _START_ALTITUDE_M + z, roll, pitch, yaw], axis=1
    )
    if len(times) > 1:
        velocity = np.gradient(T_world_imu[:, :3, 3], times, axis=0)
        packets[:, 6], packets[:, 7] = velocity[:, 1], velocity[:, 0]  # north, east
        packets[:, 8:11] = (velocity[:, None] @ T_world_imu[:, :3, :3])[:, 0]  # forward, left, up
    return packets
