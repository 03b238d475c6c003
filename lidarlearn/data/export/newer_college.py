"""Newer College's files."""

import numpy as np
import torch
from jaxtyping import Float
from numpy.typing import NDArray
from pypcd4 import PointCloud
from scipy.spatial.transform import Rotation
from torch import Tensor

from lidarlearn.data.export.exporter import Exporter, timestamps_of
from lidarlearn.data.newer_college import BEAMS, COLUMNS, PERIOD_S, T_CAMERA_LIDAR, NewerCollege
from lidarlearn.data.sequence import Scan, Sequence
from lidarlearn.errors import UserError

_START_S = 1_583_836_591  # of the first walk


class NewerCollegeExporter(Exporter[NewerCollege]):
    """Writes scans of 1024 columns of 64 points, named by the time of their first columns, and the camera's poses.

    Within a column a point takes any free row: if two columns of the drive fall into one, the surplus is left out.
    """

    option = "newer_college"

    def require(self, drive: Sequence, name: str) -> None:
        """Points have times, and scans poses."""
        _columns(drive, drive.first_returns())
        self.ground_truth(drive)

    def write(self, drive: Sequence, name: str) -> None:
        """Write scans and poses."""
        scans, truth = self.target.root / name / "raw_format/ouster_scan", self.target.root / name / "ground_truth"
        for folder in (scans, truth):
            folder.mkdir(parents=True, exist_ok=True)
        middles = (np.round(timestamps_of(drive).numpy() * 1e9).astype(np.int64) + _START_S * 10**9).tolist()
        for middle, scan in zip(middles, self.scans(drive, name), strict=True):
            seconds, nanoseconds = divmod(middle - round(PERIOD_S / 2 * 1e9), 10**9)
            cloud = PointCloud.from_points(_grid(scan, _columns(drive, scan)), ("x", "y", "z"), (np.float32,) * 3)
            cloud.save(scans / f"cloud_{seconds}_{nanoseconds:09d}.pcd")
        poses = _poses_csv(self.ground_truth(drive) @ torch.linalg.inv(T_CAMERA_LIDAR), middles)
        (truth / "registered_poses.csv").write_text(poses, encoding="utf-8")


def _columns(drive: Sequence, scan: Scan) -> NDArray[np.int64]:
    """The column of the file for each point.

    Raises:
        UserError: the points have no times.
    """
    if scan.times is None:
        raise UserError(
            f"{NewerCollege.title} tells a point's time by its place, but scans of {drive.name} have no times."
            "\n  change: data.motion_distortion=true for simulated drives, or to=folder"
        )
    return ((scan.times.numpy() + 0.5) * COLUMNS).round().astype(np.int64) % COLUMNS


def _grid(scan: Scan, columns: NDArray[np.int64]) -> NDArray[np.float32]:
    """All rows of a file, column after column; the origin where there is no point."""
    order = np.argsort(columns, kind="stable")
    first = np.searchsorted(columns[order], np.arange(COLUMNS))
    rows = np.arange(len(order)) - first[columns[order]]
    fits = rows < BEAMS
    grid = np.zeros((COLUMNS * BEAMS, 3), dtype=np.float32)
    grid[columns[order][fits] * BEAMS + rows[fits]] = scan.points.numpy()[order[fits]]
    return grid


def _poses_csv(T_world_camera: Float[Tensor, "n 4 4"], times_ns: list[int]) -> str:
    """Rows of `sec, nsec, x, y, z, qx, qy, qz, qw` [s, ns, m] below a header."""
    quaternions = Rotation.from_matrix(T_world_camera[:, :3, :3].numpy()).as_quat()
    rows = np.concatenate([T_world_camera[:, :3, 3].numpy(), quaternions], axis=1)
    lines = ["#sec,nsec,x,y,z,qx,qy,qz,qw"]
    for time_ns, row in zip(times_ns, rows, strict=True):
        lines.append(",".join([*map(str, divmod(time_ns, 10**9)), *(f"{value:.12g}" for value in row)]))
    return "\n".join(lines) + "\n"
