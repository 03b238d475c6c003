"""Poses, times and calibrations as text: rows of numbers, KITTI's 3x4 matrices, TUM's stamped quaternions."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation
from torch import Tensor

from lidarlearn.data.errors import DamagedFileError
from lidarlearn.data.interpolation import interpolate_poses
from lidarlearn.geometry import se3


@dataclass(frozen=True)
class StampedPoses:
    """Poses with the time of each.

    Args:
        timestamps: [s], ascending.
        T_world_body: 4x4 matrices.
    """

    timestamps: Float[Tensor, "n"]
    T_world_body: Float[Tensor, "n 4 4"]

    def of_lidar(self, T_body_lidar: Float[Tensor, "4 4"], timestamps: Float[Tensor, "m"]) -> Float[Tensor, "m 4 4"]:
        """Poses of a LiDAR on the body, interpolated at other times [s]; the first one is the identity."""
        return start_at_identity(interpolate_poses(self.timestamps, self.T_world_body, timestamps) @ T_body_lidar)


def read_lines(path: Path) -> list[str]:
    """The lines of a text file.

    Raises:
        DamagedFileError: absent, or no text.
    """
    try:
        return path.read_text(encoding="utf-8-sig").splitlines()
    except (OSError, UnicodeDecodeError) as error:
        raise DamagedFileError(path, f"cannot be read: {error}") from error


def read_numbers(path: Path, columns: int, delimiter: str | None = None) -> NDArray[np.float64]:
    """Read a text file of rows of numbers; `#` begins a comment, NaN is allowed.

    Raises:
        DamagedFileError: absent, empty, not numbers, or another number of columns.
    """
    lines = [line for line in read_lines(path) if line.split("#")[0].strip()]
    if not lines:
        raise DamagedFileError(path, "the file is empty")
    try:
        rows = np.loadtxt(lines, dtype=np.float64, delimiter=delimiter, ndmin=2)
    except ValueError as error:
        raise DamagedFileError(path, f"not a table of numbers: {str(error).split(';')[0]}") from error
    if rows.shape[1] != columns:
        raise DamagedFileError(path, f"{rows.shape[1]} numbers in a row where {columns} are expected")
    return rows


def require_finite(path: Path, rows: NDArray[np.float64]) -> None:
    """Raise DamagedFileError with the number of the first row that is not finite."""
    bad = np.flatnonzero(~np.isfinite(rows).all(axis=1))
    if len(bad):
        raise DamagedFileError(path, f"{len(bad)} rows are not finite, the first is row {bad[0] + 1}")


def require_ascending(path: Path, times: NDArray[np.float64]) -> None:
    """Raise DamagedFileError with the number of the first row whose time is not after that of the row before."""
    late = np.flatnonzero(np.diff(times) <= 0)
    if len(late):
        problem = f"time stamps that do not ascend, the first is in row {late[0] + 2}"
        raise DamagedFileError(path, problem, "give each row a time after that of the row before")


def read_times(path: Path) -> Float[Tensor, "n"]:
    """Read times [s], one a row.

    Raises:
        DamagedFileError: not such a file, not finite, or times that do not ascend.
    """
    rows = read_numbers(path, columns=1)
    require_finite(path, rows)
    require_ascending(path, rows[:, 0])
    return torch.from_numpy(rows[:, 0])


def read_kitti_poses(path: Path) -> Float[Tensor, "n 4 4"]:
    """Read poses written as the twelve numbers of a 3x4 matrix in row-major order, without correcting rotations.

    Raises:
        DamagedFileError: not such a file.
    """
    rows = read_numbers(path, columns=12)
    require_finite(path, rows)
    return as_transforms(torch.from_numpy(rows).reshape(-1, 3, 4))


def read_tum_poses(path: Path) -> StampedPoses:
    """Read poses written as `timestamp tx ty tz qx qy qz qw` [s, m].

    Raises:
        DamagedFileError: not such a file, a quaternion of length zero, or times that do not ascend.
    """
    return stamped_poses(path, read_numbers(path, columns=8))


def stamped_poses(path: Path, rows: NDArray[np.float64]) -> StampedPoses:
    """Poses from rows of `time, x, y, z, qx, qy, qz, qw`.

    Args:
        path: the file that they come from.
        rows: (n, 8) [s, m].

    Raises:
        DamagedFileError: not finite, a quaternion of length zero, or times that do not ascend.
    """
    require_finite(path, rows)
    if (np.linalg.norm(rows[:, 4:], axis=1) < 0.5).any():
        raise DamagedFileError(path, "a quaternion that is not of length 1")
    require_ascending(path, rows[:, 0])
    R = torch.from_numpy(Rotation.from_quat(rows[:, 4:]).as_matrix())
    T = se3.from_rotation_translation(R, torch.from_numpy(rows[:, 1:4]))
    return StampedPoses(torch.from_numpy(rows[:, 0].copy()), T)


def read_labelled_transform(path: Path, label: str) -> Float[Tensor, "4 4"]:
    """The transform on the first line that begins with `label`, as twelve numbers; `Tr:` of KITTI's calib.txt.

    Raises:
        DamagedFileError: no such line, or not twelve numbers.
    """
    lines = [line.removeprefix(label) for line in read_lines(path) if line.startswith(label)]
    try:
        numbers = torch.tensor([float(value) for value in lines[0].split()], dtype=torch.float64)
        return as_transforms(numbers.reshape(3, 4))
    except (IndexError, ValueError, RuntimeError) as error:
        raise DamagedFileError(path, f"no line {label!r} with twelve numbers") from error


def write_times(path: Path, timestamps: Float[Tensor, "n"]) -> None:
    """Write times [s], one a row, to the nanosecond."""
    path.write_text("".join(f"{time:.9f}\n" for time in timestamps.tolist()), encoding="utf-8")


def write_kitti_poses(path: Path | str, T_world: Float[Tensor, "n 4 4"]) -> None:
    """Write poses in KITTI's format, see `kitti_row`; makes the folder."""
    path = Path(path)
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text("".join(f"{kitti_row(T)}\n" for T in T_world), encoding="utf-8")


def kitti_row(T: Float[Tensor, "4 4"]) -> str:
    """The upper three rows of a transform as twelve numbers of 13 significant digits."""
    return " ".join(f"{value:.12e}" for value in T[:3].flatten().tolist())


def write_tum_poses(path: Path | str, T_world: Float[Tensor, "n 4 4"], timestamps: Float[Tensor, "n"] | None) -> None:
    """Write poses in TUM's format: time [s], position [m], quaternion (x y z w), w >= 0; makes the folder.

    Args:
        path: of the file.
        T_world: the poses.
        timestamps: of each pose [s]; None writes the number of the frame instead.
    """
    times = torch.arange(len(T_world), dtype=torch.float64) if timestamps is None else timestamps
    path = Path(path)
    path.parent.mkdir(parents=True, exist_ok=True)
    with path.open("w", encoding="utf-8") as file:
        file.write("# time [s] tx ty tz [m] qx qy qz qw\n")
        if not len(T_world):
            return
        quaternions = Rotation.from_matrix(T_world[:, :3, :3].cpu().numpy()).as_quat(canonical=True)
        rows = np.concatenate([T_world[:, :3, 3].cpu().numpy(), quaternions], axis=1)
        for time, row in zip(times.tolist(), rows, strict=True):
            file.write(f"{time:.9f} " + " ".join(f"{value:.12e}" for value in row) + "\n")


def transforms_from_euler(position: NDArray[np.float64], roll_pitch_yaw: NDArray[np.float64]) -> Float[Tensor, "n 4 4"]:
    """Transforms from positions [m] and angles [rad], both (n, 3), with R = Rz(yaw) Ry(pitch) Rx(roll)."""
    R = Rotation.from_euler("ZYX", roll_pitch_yaw[:, ::-1]).as_matrix()
    return se3.from_rotation_translation(torch.from_numpy(R), torch.from_numpy(position))


def euler_from_transforms(T: Float[Tensor, "n 4 4"]) -> NDArray[np.float64]:
    """Roll, pitch and yaw [rad] (n, 3), the inverse of `transforms_from_euler`."""
    return Rotation.from_matrix(T[:, :3, :3].numpy()).as_euler("ZYX")[:, ::-1]


def as_transforms(top: Float[Tensor, "*batch 3 4"]) -> Float[Tensor, "*batch 4 4"]:
    """4x4 matrices from their upper three rows."""
    bottom = torch.zeros_like(top[..., :1, :])
    bottom[..., 3] = 1
    return torch.cat([top, bottom], dim=-2)


def start_at_identity(T_world: Float[Tensor, "n 4 4"]) -> Float[Tensor, "n 4 4"]:
    """The same motion with the first pose as the world frame.

    Uses a general matrix inverse, since published rotations are orthonormal only to the digits printed.
    """
    T = torch.linalg.inv(T_world[0]) @ T_world
    T[0] = torch.eye(4, dtype=T.dtype)
    return T
