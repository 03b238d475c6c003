"""Newer College's files."""

import numpy as np
import torch
from numpy.typing import NDArray
from pypcd4 import PointCloud
from scipy.spatial.transform import Rotation

from lidarlearn.data.beam_correction import raise_beams
from lidarlearn.data.export.drives import ground_truth_of, scans_of, timestamps_of
from lidarlearn.data.newer_college import BEAMS, COLUMNS, PERIOD_S, T_CAMERA_LIDAR, NewerCollege
from lidarlearn.data.sequence import Scan, Sequence
from lidarlearn.errors import UserError

_START_S = 1_583_836_591  # of the first walk


def require_newer_college(drive: Sequence, target: NewerCollege, name: str) -> None:
    """Raise UserError unless points have times, and scans poses."""
    _columns(drive, drive.first_returns())
    ground_truth_of(drive, target.title)


def write_newer_college(drive: Sequence, target: NewerCollege, name: str) -> None:
    """Scans of 1024 columns of 64 points, the times of their first columns in their names, and the camera's poses.

    Within a column a point takes any free row: where two columns of the drive fall into one, the surplus is left out.
    """
    T_world_camera = (ground_truth_of(drive, target.title) @ torch.linalg.inv(T_CAMERA_LIDAR)).numpy()
    middles = np.round(timestamps_of(drive).numpy() * 1e9).astype(np.int64) + _START_S * 10**9
    folder = target.root / name
    for part in ("raw_format/ouster_scan", "ground_truth"):
        (folder / part).mkdir(parents=True, exist_ok=True)
    for middle, scan in zip(middles.tolist(), scans_of(drive, name), strict=True):
        columns = _columns(drive, scan)
        order = np.argsort(columns, kind="stable")
        first = np.searchsorted(columns[order], np.arange(COLUMNS))
        rows = np.arange(len(order)) - first[columns[order]]
        fits = rows < BEAMS
        grid = np.zeros((COLUMNS * BEAMS, 3), dtype=np.float32)
        points = raise_beams(scan.points, -target.beam_correction_deg).numpy()
        grid[columns[order][fits] * BEAMS + rows[fits]] = points[order[fits]]
        seconds, nanoseconds = divmod(middle - round(PERIOD_S / 2 * 1e9), 10**9)
        cloud = PointCloud.from_points(grid, ("x", "y", "z"), (np.float32,) * 3)
        cloud.save(folder / "raw_format" / "ouster_scan" / f"cloud_{seconds}_{nanoseconds:09d}.pcd")
    quaternions = Rotation.from_matrix(T_world_camera[:, :3, :3]).as_quat()
    lines = ["#sec,nsec,x,y,z,qx,qy,qz,qw"]
    for middle, row in zip(middles.tolist(), np.concatenate([T_world_camera[:, :3, 3], quaternions], 1), strict=True):
        lines.append(",".join([*map(str, divmod(middle, 10**9)), *(f"{value:.12g}" for value in row)]))
    (folder / "ground_truth" / "registered_poses.csv").write_text("\n".join(lines) + "\n", encoding="utf-8")


def _columns(drive: Sequence, scan: Scan) -> NDArray[np.int64]:
    """In which column of the file each point goes.

    Raises:
        UserError: the points have no times.
    """
    if scan.times is None:
        raise UserError(
            f"{NewerCollege.title} tells a point's time by its place, but scans of {drive.name} have no times."
            "\n  change: data.motion_distortion=true for simulated drives, or to=folder"
        )
    return ((scan.times.numpy() + 0.5) * COLUMNS).round().astype(np.int64) % COLUMNS
