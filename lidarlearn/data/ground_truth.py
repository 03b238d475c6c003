"""Ground truth beside recordings that have no format of their own for it: poses of the LiDAR in KITTI's or TUM's."""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from jaxtyping import Float
from torch import Tensor

from lidarlearn.data import layout
from lidarlearn.data.errors import DamagedFileError
from lidarlearn.data.interpolation import covered, interpolate_poses
from lidarlearn.data.pose_files import read_kitti_poses, read_lines, read_tum_poses, start_at_identity
from lidarlearn.data.scan_files import full_path
from lidarlearn.data.sequence import LayoutReport

_INSIDE = ("poses.txt", "poses.tum", "groundtruth.txt")
_BESIDE = (".txt", ".tum")
_SLACK_S = 0.1  # by which a scan may be before the first or after the last pose


@dataclass(frozen=True)
class PosedScans:
    """The scans that have a pose.

    Args:
        indices: which of the scans.
        T_world_lidar: the pose of each, the first one the identity.
    """

    indices: list[int]
    T_world_lidar: Float[Tensor, "n 4 4"]


@dataclass(frozen=True)
class GroundTruth:
    """Poses of the LiDAR as a file holds them.

    Args:
        path: of the file.
        T_world_lidar: the poses.
        timestamps: of TUM's [s], ascending; None for KITTI's, which belong to the scans in order.
    """

    path: Path
    T_world_lidar: Float[Tensor, "n 4 4"]
    timestamps: Float[Tensor, "n"] | None

    @property
    def start_s(self) -> float:
        """Time before which scans are left out; minus infinity where rows belong to the scans in order."""
        return -math.inf if self.timestamps is None else float(self.timestamps[0]) - _SLACK_S

    def of_scans(
        self, name: str, rows: Sequence[int], count: int | None, timestamps: Float[Tensor, "n"] | None
    ) -> PosedScans:
        """KITTI's rows, or TUM's poses at the times of scans; of these, scans that the times do not cover are left out.

        TUM's rows belong to the scans in order, too, where these have no times.

        Args:
            name: of the sequence.
            rows: the row of each scan where they belong to the scans in order.
            count: of rows that there have to be then; None where no more is known than that each scan needs one.
            timestamps: of the scans [s]; None where there are none.

        Raises:
            DamagedFileError: another number of poses than scans, or no scan within their times.
        """
        if self.timestamps is None or timestamps is None:
            there = len(self.T_world_lidar)
            if there != count and (count is not None or there <= max(rows)):
                needed = f"{count} scans" if count is not None else f"the first {max(rows) + 1} scans"
                raise DamagedFileError(self.path, f"{there} poses for {needed}", "give every scan a row or a time")
            return PosedScans(list(range(len(rows))), start_at_identity(self.T_world_lidar[list(rows)]))
        if len(self.timestamps) < 2:
            raise DamagedFileError(self.path, "a single pose with a time", "give at least two")
        indices = covered(name, timestamps, self.timestamps, _SLACK_S)
        if not indices:
            raise DamagedFileError(self.path, *_no_overlap(self.timestamps, timestamps))
        poses = interpolate_poses(self.timestamps, self.T_world_lidar, timestamps[indices])
        return PosedScans(indices, start_at_identity(poses))


def find_ground_truth(recording: Path, name: str | None = None) -> Path | None:
    """The file with a recording's ground truth; None where there is none.

    Args:
        recording: a folder, in which it may lie, or a file.
        name: of the file beside the recording, without its suffix; None for the recording's own.
    """
    recording = full_path(recording)
    inside = [recording / file for file in _INSIDE]
    beside = [recording.with_name(f"{name or recording.name}{suffix}") for suffix in _BESIDE]
    return next((path for path in inside + beside if path.is_file()), None)


def read_ground_truth(path: Path) -> GroundTruth:
    """Poses in KITTI's format, where a row has twelve numbers, or else in TUM's.

    Raises:
        DamagedFileError: no such file.
    """
    rows = (row for line in read_lines(path) if (row := line.partition("#")[0].split()))
    if len(next(rows, [])) == 12:
        return GroundTruth(path, read_kitti_poses(path), None)
    stamped = read_tum_poses(path)
    return GroundTruth(path, stamped.T_world_body, stamped.timestamps)


def describe_ground_truth(report: LayoutReport, name: str, path: Path | None) -> None:
    """Note a recording's ground truth, or that there is none."""
    if path is None:
        report.odd(name, "no ground truth: errors will not be defined, and the supervised loss cannot be used")
    else:
        report.found(name, f"ground truth in {path} with {layout.count_rows(path)} rows")


def describe_coverage(
    report: LayoutReport, name: str, truth: GroundTruth, count: int, first_s: float, last_s: float
) -> None:
    """Note where ground truth is not of all scans of a recording.

    Args:
        report: what is added to.
        name: of the sequence.
        truth: the poses.
        count: of messages, of which some may be empty.
        first_s: time of the first.
        last_s: time of the last.
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


def _no_overlap(times: Float[Tensor, "n"], scan_times: Float[Tensor, "m"]) -> tuple[str, str]:
    """What is wrong, and what to do."""
    return (
        f"its times ({times[0]:.3f} to {times[-1]:.3f} s) do not cover those of the scans "
        f"({scan_times.min():.3f} to {scan_times.max():.3f} s)",
        "use one clock in both files",
    )
