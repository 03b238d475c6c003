"""Ground truth of recordings: poses of the LiDAR in KITTI's or TUM's format, in or beside the recording's folder."""

import math
from collections.abc import Collection
from dataclasses import dataclass
from pathlib import Path

from jaxtyping import Float
from torch import Tensor

from lidarlearn.data.errors import DamagedFileError
from lidarlearn.data.interpolation import covered, interpolate_poses
from lidarlearn.data.layout import LayoutReport
from lidarlearn.data.pose_files import read_kitti_poses, read_lines, read_tum_poses, start_at_identity
from lidarlearn.data.scan_files import full_path

_INSIDE = ("poses.txt", "poses.tum", "groundtruth.txt")
_BESIDE = (".txt", ".tum")
_SLACK_S = 0.1  # a scan may be this long before the first or after the last pose


@dataclass(frozen=True)
class PosedScans:
    """The scans that have a pose.

    Args:
        indices: of the scans.
        T_world_lidar: pose of each, the first one the identity.
    """

    indices: list[int]
    T_world_lidar: Float[Tensor, "n 4 4"]


@dataclass(frozen=True)
class GroundTruth:
    """Poses of the LiDAR as a file holds them.

    Args:
        path: of the file.
        T_world_lidar: the poses.
        timestamps: of each pose in TUM's format [s], ascending; None in KITTI's, where rows follow the scans' order.
    """

    path: Path
    T_world_lidar: Float[Tensor, "n 4 4"]
    timestamps: Float[Tensor, "n"] | None

    @property
    def start_s(self) -> float:
        """Scans before this time are left out [s]; minus infinity for KITTI's format."""
        return -math.inf if self.timestamps is None else float(self.timestamps[0]) - _SLACK_S

    def of_scans(
        self, name: str, rows: Collection[int], count: int | None, timestamps: Float[Tensor, "n"] | None
    ) -> PosedScans:
        """The scans that have a pose: interpolated if poses and scans have times, else the row of each scan.

        Args:
            name: of the sequence.
            rows: the row of each scan, if rows follow the scans' order.
            count: number of rows there must be then; None if it is enough that every scan has one.
            timestamps: of the scans [s]; None if unknown.

        Raises:
            DamagedFileError: the number of poses does not match that of the scans, or their times do not overlap.
        """
        if self.timestamps is None or timestamps is None:
            return self._in_order(rows, count)
        return self._interpolated(name, self.timestamps, timestamps)

    def _in_order(self, rows: Collection[int], count: int | None) -> PosedScans:
        there = len(self.T_world_lidar)
        if there != count and (count is not None or there <= max(rows)):
            needed = f"{count} scans" if count is not None else f"the first {max(rows) + 1} scans"
            raise DamagedFileError(self.path, f"{there} poses for {needed}", "give every scan a row or a time")
        return PosedScans(list(range(len(rows))), start_at_identity(self.T_world_lidar[list(rows)]))

    def _interpolated(self, name: str, times: Float[Tensor, "n"], scan_times: Float[Tensor, "m"]) -> PosedScans:
        indices = covered(self.path, name, scan_times, times, _SLACK_S)
        poses = interpolate_poses(times, self.T_world_lidar, scan_times[indices])
        return PosedScans(indices, start_at_identity(poses))


def find_ground_truth(recording: Path, name: str | None = None) -> Path | None:
    """The file with a recording's ground truth; None if there is none.

    Args:
        recording: a folder, which may hold the file, or a file.
        name: of a file beside the recording, without suffix; None for the recording's own name.
    """
    recording = full_path(recording)
    inside = [recording / file for file in _INSIDE]
    beside = [recording.with_name(f"{name or recording.name}{suffix}") for suffix in _BESIDE]
    return next((path for path in inside + beside if path.is_file()), None)


def read_ground_truth(path: Path) -> GroundTruth:
    """Read poses in KITTI's format if the first row has twelve numbers, else in TUM's.

    Raises:
        DamagedFileError: no such file, or in neither format.
    """
    rows = (row for line in read_lines(path) if (row := line.partition("#")[0].split()))
    if len(next(rows, [])) == 12:
        return GroundTruth(path, read_kitti_poses(path), None)
    stamped = read_tum_poses(path)
    return GroundTruth(path, stamped.T_world_body, stamped.timestamps)


def describe_coverage(
    report: LayoutReport, name: str, truth: GroundTruth, count: int, first_s: float, last_s: float
) -> None:
    """Note if ground truth does not cover all scans of a recording.

    Args:
        report: the report to extend.
        name: of the sequence.
        truth: the poses.
        count: number of messages; some may be empty.
        first_s: time of the first message.
        last_s: time of the last message.
    """
    if truth.timestamps is None:
        if len(truth.T_world_lidar) != count:
            report.odd(name, f"{len(truth.T_world_lidar)} poses for {count} messages: each with points needs one")
        return
    start_s, end_s = truth.start_s, float(truth.timestamps[-1]) + _SLACK_S
    seen = f"ground truth from {start_s + _SLACK_S:.3f} to {end_s - _SLACK_S:.3f} s"
    if last_s < start_s or first_s > end_s:
        report.missing(name, f"{seen}, but scans from {first_s:.3f} to {last_s:.3f} s: use one clock in both files")
    elif first_s < start_s or last_s > end_s:
        report.odd(name, f"{seen}, of scans from {first_s:.3f} to {last_s:.3f} s: those outside are left out")
