"""The GPS/IMU packets, time stamps and calibrations of KITTI raw."""

from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float
from numpy.typing import NDArray
from torch import Tensor

from lidarlearn.data.errors import DamagedFileError
from lidarlearn.data.pose_files import read_lines, read_numbers, require_finite, transforms_from_euler
from lidarlearn.data.scan_files import ScanFiles
from lidarlearn.geometry import se3

EARTH_RADIUS_M = 6378137.0
_COLUMNS = 30


def read_oxts_poses(packets: ScanFiles) -> Float[Tensor, "n 4 4"]:
    """T_world_imu of each packet: x east, y north, z up in a Mercator projection true to scale at the first packet.

    Raises:
        DamagedFileError: a packet is empty, incomplete or not finite.

    Source: Geiger et al. 2013, "Vision meets Robotics", and the raw data development kit.
    """
    rows = []
    for i in range(len(packets)):
        row = read_numbers(packets.path(i), columns=_COLUMNS)[:1, :6]
        require_finite(packets.path(i), row)
        rows.append(row)
    latitude, longitude, altitude, roll, pitch, yaw = np.concatenate(rows).T
    position = mercator(latitude, longitude, altitude)
    return transforms_from_euler(position, np.stack([roll, pitch, yaw], axis=1))


def mercator(
    latitude_deg: NDArray[np.float64], longitude_deg: NDArray[np.float64], altitude: NDArray[np.float64]
) -> NDArray[np.float64]:
    """East, north, up [m] (n, 3) of a Mercator projection that is true to scale at the first latitude."""
    scale = np.cos(np.radians(latitude_deg[0])) * EARTH_RADIUS_M
    north = np.log(np.tan(np.pi / 4 + np.radians(latitude_deg) / 2))
    return np.stack([scale * np.radians(longitude_deg), scale * north, altitude], axis=1)


def read_timestamps(path: Path, numbers: list[int]) -> Float[Tensor, "n"]:
    """Read times [s] from some lines of a file of dates with nanoseconds; blank lines stand for dropped frames.

    Args:
        path: of the file.
        numbers: of the lines, from 0.

    Raises:
        DamagedFileError: a line is missing, blank or not a date.
    """
    lines = read_lines(path)
    if numbers and max(numbers) >= len(lines):
        raise DamagedFileError(path, f"{len(lines)} rows, too few for frame {max(numbers)}")
    try:
        stamps = np.array([lines[i].strip().replace(" ", "T") for i in numbers], dtype="datetime64[ns]")
    except ValueError as error:
        raise DamagedFileError(path, f"not a date: {error}") from error
    if np.isnat(stamps).any():
        blank = numbers[int(np.flatnonzero(np.isnat(stamps))[0])]
        raise DamagedFileError(path, f"row {blank + 1} is blank, but frame {blank} is there")
    return torch.from_numpy(stamps.astype(np.int64) * 1e-9)


def write_timestamps(path: Path, day: np.datetime64, seconds: Float[Tensor, "n"]) -> None:
    """Write dates with nanoseconds, one a line.

    Args:
        path: of the file.
        day: of the recording, which begins at noon.
        seconds: of each line, from noon.
    """
    stamps = day + np.timedelta64(12, "h") + np.round(seconds.numpy() * 1e9).astype("timedelta64[ns]")
    path.write_text("".join(f"{str(stamp).replace('T', ' ')}\n" for stamp in stamps), encoding="utf-8")


def read_rigid_transform(path: Path) -> Float[Tensor, "4 4"]:
    """The transform of a calibration file with lines `R:` (nine numbers) and `T:` (three), as in calib_imu_to_velo.txt.

    Raises:
        DamagedFileError: not such a file.
    """
    entries = dict(line.split(":", 1) for line in read_lines(path) if ":" in line)
    try:
        R = torch.tensor([float(v) for v in entries["R"].split()], dtype=torch.float64).reshape(3, 3)
        t = torch.tensor([float(v) for v in entries["T"].split()], dtype=torch.float64).reshape(3)
    except (KeyError, ValueError, RuntimeError) as error:
        raise DamagedFileError(path, "no lines 'R:' with nine and 'T:' with three numbers") from error
    return se3.from_rotation_translation(R, t)
