"""Find and read trajectory files in KITTI's and TUM's formats, and convert their poses between frames."""

from pathlib import Path

import torch
from jaxtyping import Float, Int
from torch import Tensor

from lidarlearn.data.pose_files import read_kitti_poses, read_tum_poses
from lidarlearn.data.sequence import Sequence
from lidarlearn.errors import UserError
from lidarlearn.metrics.relative import relative_translation_error

_KITTI_COLUMNS = 12
_TUM_COLUMNS = 8
_FAR_BETTER = 1 / 3  # poses are taken for those of another frame if their error there is less than this share
_MAX_DEVIATION = 1e-2  # of R R^T from the identity; some tools write only three digits


class TrajectoryError(UserError):
    """A trajectory file that is missing, cannot be read, or does not belong to its sequence."""


def read_trajectory(
    path: Path, timestamps: Float[Tensor, "m"] | None = None, tolerance_s: float = 0.01
) -> Float[Tensor, "n 4 4"]:
    """Read poses from a file in KITTI's or TUM's format, recognized by the number of columns.

    Args:
        path: the file; blank lines and comments after a # are skipped.
        timestamps: times of the scans [s]. For each scan, the pose nearest in time is taken from a TUM file, and other
            poses are ignored; None takes every row.
        tolerance_s: largest accepted time difference between a scan and its pose.

    Returns:
        Absolute poses, float64, in the file's own frame; matrices are not orthonormalized.

    Raises:
        TrajectoryError: the file is missing, in another format, or has no pose for a scan.
        DamagedFileError: a row is malformed.
    """
    columns = _columns(path)
    if columns == _KITTI_COLUMNS:
        T_world = read_kitti_poses(path)
        _require_rotations(path, T_world)
        return T_world
    if columns == _TUM_COLUMNS:
        poses = read_tum_poses(path)
        chosen = slice(None) if timestamps is None else _match(path, poses.timestamps, timestamps, tolerance_s)
        return poses.T_world_body[chosen]
    raise TrajectoryError(
        f"{path.absolute()}: {columns} numbers in its first row.\n"
        "  change: one pose a row, as 12 numbers (KITTI: 3x4 matrix) or 8 (TUM: time x y z qx qy qz qw), "
        "separated by spaces"
    )


def lidar_poses(
    T_world: Float[Tensor, "n 4 4"], stated: str | None, sequence: Sequence, path: Path
) -> Float[Tensor, "n 4 4"]:
    """Convert the poses of a file to poses of the LiDAR.

    Args:
        T_world: poses in the file.
        stated: their frame, as stated by the user; None assumes the frame of the data set's own poses, in which our
            trajectories are exported as well.
        sequence: the sequence to which they belong.
        path: the file.

    Raises:
        TrajectoryError: no frame is stated, and they fit the ground truth far better as poses of the LiDAR.
    """
    reference = sequence.reference_frame
    T_world_lidar = to_lidar_frame(T_world, stated or reference, sequence)
    T_true = sequence.T_world_lidar
    if stated is None and T_true is not None and len(T_true) == len(T_world) and bool(T_world.isfinite().all()):
        as_stated, as_lidar = (relative_translation_error(T, T_true) for T in (T_world_lidar, T_world))
        if as_stated is not None and as_lidar is not None and as_lidar < _FAR_BETTER * as_stated:
            raise TrajectoryError(
                f"{path.absolute()}: the motions are {100 * as_stated:.0f} % off as poses of the {reference}, the "
                f"frame of this data set's own poses, but {100 * as_lidar:.0f} % as poses of the LiDAR.\n"
                f"  change: trajectories_frame=lidar, or trajectories_frame={reference} if that is right nevertheless"
            )
    return T_world_lidar


def to_lidar_frame(T_world: Float[Tensor, "n 4 4"], frame: str, sequence: Sequence) -> Float[Tensor, "n 4 4"]:
    """Convert poses of another frame to poses of the LiDAR.

    Args:
        T_world: absolute poses of `frame`; the first one is arbitrary.
        frame: e.g. "camera" or "lidar".
        sequence: the sequence to which the poses belong.

    Raises:
        TrajectoryError: the data set does not define the frame.
    """
    if frame == "lidar":
        return T_world
    if frame != sequence.reference_frame:
        raise TrajectoryError(
            f"trajectories are said to be in the frame '{frame}', but this data set only relates the frames "
            f"{' and '.join(sorted({'lidar', sequence.reference_frame}))}.\n  change: state one of these frames"
        )
    return torch.linalg.inv(sequence.T_reference_lidar) @ T_world @ sequence.T_reference_lidar


def to_reference_frame(
    T_world_lidar: Float[Tensor, "n 4 4"], T_reference_lidar: Float[Tensor, "4 4"]
) -> Float[Tensor, "n 4 4"]:
    """Convert poses of the LiDAR to poses of the data set's reference frame; for KITTI, T_cam = Tr T_velo Tr^-1.

    The inverse is that of a general matrix: the rotation in KITTI's Tr is accurate to seven digits only.
    """
    return T_reference_lidar @ T_world_lidar @ torch.linalg.inv(T_reference_lidar)


def find_trajectories(path: Path, sequences: list[str]) -> dict[str, dict[str, Path]]:
    """Find trajectory files of any tool, by method and sequence.

    Args:
        path: a file (for one sequence), a folder of `<sequence>.txt` or `.tum` files, a folder with one such folder per
            method, or the run folder of an evaluation. Methods are named after their folders; the method of a single
            file after the file, unless this is named after the sequence.
        sequences: names of all sequences to be scored.

    Raises:
        TrajectoryError: there are no trajectories, or a method lacks a sequence.
    """
    if path.is_file():
        if len(sequences) != 1:
            raise TrajectoryError(
                f"{path}: one trajectory for {len(sequences)} sequences ({', '.join(sequences)}).\n"
                "  change: name one sequence (data.test_sequences), or give a folder of <sequence>.txt"
            )
        method = path.absolute().parent.name if path.stem == sequences[0] else path.stem
        return {method: {sequences[0]: path}}
    if not path.is_dir():
        raise TrajectoryError(
            f"{path.absolute()}: no such file or folder of trajectories.\n  change: trajectories=PATH"
        )
    path = path / "trajectories" if (path / "trajectories").is_dir() else path
    folders = [path, *sorted(p for p in path.iterdir() if p.is_dir())]
    found = {folder.absolute().name: _in_folder(folder, sequences) for folder in folders}
    found = {method: files for method, files in found.items() if files}
    if not found:
        there = ", ".join(sorted(p.name for p in path.iterdir())[:8]) or "nothing"
        raise TrajectoryError(
            f"{path.absolute()}: no trajectory of the sequences {', '.join(sequences)}; there is: {there}.\n"
            "  change: name the files <sequence>.txt (KITTI or TUM format), or set data.test_sequences"
        )
    for method, files in found.items():
        missing = [name for name in sequences if name not in files]
        if missing:
            raise TrajectoryError(
                f"{path.absolute()}: '{method}' has no trajectory for {', '.join(missing)}.\n"
                f"  change: add the files, or set data.test_sequences={list(files)}"
            )
    return found


def _in_folder(folder: Path, sequences: list[str]) -> dict[str, Path]:
    """The file of each sequence that has one; a .txt takes precedence over a .tum."""
    candidates = ((name, folder / f"{name}{suffix}") for name in sequences for suffix in (".tum", ".txt"))
    return {name: path for name, path in candidates if path.is_file()}


def _columns(path: Path) -> int:
    """The number of columns in the first row of a trajectory file; 0 if there is none."""
    if not path.is_file():
        raise TrajectoryError(f"{path.absolute()}: no such trajectory.\n  change: trajectories=PATH")
    with path.open(encoding="utf-8", errors="replace") as file:
        for line in file:
            words = line.split("#")[0].split()
            if words:
                return len(words)
    return 0


def _require_rotations(path: Path, T_world: Float[Tensor, "n 4 4"]) -> None:
    """Raise a `TrajectoryError` if a matrix is no rotation, e.g. because the columns have another order."""
    R = T_world[:, :3, :3]
    deviation = (R @ R.mT - torch.eye(3, dtype=R.dtype)).abs().amax((1, 2))
    bad = (deviation > _MAX_DEVIATION) | (torch.linalg.det(R) < 0)
    if bool(bad.any()):
        row = int(bad.int().argmax())
        numbers = [[round(value, 3) for value in line] for line in R[row].tolist()]
        raise TrajectoryError(
            f"{path.absolute()}: the 3x3 part of row {row + 1} is not a rotation: {numbers}.\n"
            "  change: write the upper 3x4 part of each pose row by row (r11 r12 r13 tx r21 ...)"
        )


def _match(
    path: Path, times: Float[Tensor, "n"], timestamps: Float[Tensor, "m"], tolerance_s: float
) -> Int[Tensor, "m"]:
    """Index of the nearest pose in time for each scan."""
    after = torch.searchsorted(times, timestamps).clamp(max=len(times) - 1)
    before = (after - 1).clamp(min=0)
    nearest = torch.where((times[after] - timestamps).abs() < (timestamps - times[before]).abs(), after, before)
    far = (times[nearest] - timestamps).abs() > tolerance_s
    if bool(far.any()):
        scan = int(far.int().argmax())
        raise TrajectoryError(
            f"{path.absolute()}: {int(far.sum())} of {len(timestamps)} scans have no pose within {tolerance_s} s, the "
            f"first is scan {scan} at {float(timestamps[scan]):.6f} s; the file's times run from {float(times[0]):.6f} "
            f"to {float(times[-1]):.6f} s.\n  change: write the scans' own times, or one row a scan in KITTI's format"
        )
    return nearest
