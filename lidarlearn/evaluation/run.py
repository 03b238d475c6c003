"""Run odometries over sequences and export their results. Scores are computed from these files only."""

import json
import statistics
import time
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from lidarlearn.data.pose_files import write_kitti_poses, write_tum_poses
from lidarlearn.data.sequence import Sequence
from lidarlearn.data.writable import atomic_write
from lidarlearn.errors import UserError
from lidarlearn.evaluation.trajectory_files import read_trajectory, to_lidar_frame, to_reference_frame
from lidarlearn.odometry.base import BaseOdometry
from lidarlearn.odometry.health import Health, write_health


@dataclass(frozen=True)
class Export:
    """The files that a method writes for a sequence.

    Args:
        folder: `trajectories/<method>`.
        sequence: name of the sequence.
    """

    folder: Path
    sequence: str

    @property
    def kitti(self) -> Path:
        """Poses of the data set's reference frame, KITTI format."""
        return self.folder / f"{self.sequence}.txt"

    @property
    def tum(self) -> Path:
        """The same, TUM format."""
        return self.folder / f"{self.sequence}.tum"

    @property
    def health(self) -> Path:
        """One row per frame, see `Health`."""
        return self.folder / f"{self.sequence}.health.csv"

    @property
    def summary(self) -> Path:
        """The settings of the run, its speed, the summary of the health records; written last."""
        return self.folder / f"{self.sequence}.json"

    def remove(self) -> None:
        """Remove the existing files."""
        for path in (self.summary, self.kitti, self.tum, self.health):
            path.unlink(missing_ok=True)

    def settings(self) -> dict[str, Any] | None:
        """The settings of a finished run; None if there is none."""
        if not (self.summary.is_file() and self.kitti.is_file()):
            return None
        return json.loads(self.summary.read_text(encoding="utf-8")).get("settings")


def run_odometry(
    odometry: BaseOdometry,
    sequence: Sequence,
    export: Export,
    deskew: bool = False,
    advance: Callable[[], None] = lambda: None,
    settings: Mapping[str, Any] | None = None,
) -> None:
    """Feed a sequence to an odometry and export trajectory, health records and speed.

    The speed does not include reading scans. Files of an earlier run are removed first. After a damaged scan or an
    interrupt, the frames before are exported under names that end in `.partial`, and the error is raised again.

    Args:
        odometry: a new one.
        sequence: the scans.
        export: the files to write.
        deskew: whether the odometry gets the times of the points.
        advance: called after each scan.
        settings: everything that the result depends on, stored with it; plain values, lists and mappings.
    """
    partial = Export(export.folder, f"{export.sequence}.partial")
    export.remove()
    partial.remove()
    poses: list[Tensor] = []
    records: list[Health] = []
    seconds = 0.0
    try:
        for scan in sequence:
            start = time.perf_counter()
            frame = odometry.register_scan(scan.points, scan.times if deskew else None)
            seconds += time.perf_counter() - start
            poses.append(frame.T_world_lidar)
            records.append(frame.health)
            advance()
    except (UserError, KeyboardInterrupt):
        if poses:
            _write(partial, sequence, poses, records, seconds, settings)
        raise
    _write(export, sequence, poses, records, seconds, settings)


def read_export(export: Export, sequence: Sequence) -> tuple[Float[Tensor, "n 4 4"], dict[str, Any]]:
    """Poses of the LiDAR and the summary of an exported run."""
    poses = read_trajectory(export.kitti)
    summary = json.loads(export.summary.read_text(encoding="utf-8"))
    return to_lidar_frame(poses, sequence.reference_frame, sequence), summary


def summarize_health(records: Iterable[Health]) -> dict[str, float | int | None]:
    """Counts of flagged scans of a sequence, by reason, and means over the registered scans."""
    records = list(records)
    return {
        "flagged": sum(h.flagged for h in records),
        "recovered": sum(h.status == "recovered" for h in records),
        "coasted": sum(h.status in ("coasted", "restarted") for h in records),
        "degenerate": sum(h.degenerate for h in records),
        "implausible": sum(h.implausible for h in records),
        "mean_iterations": _mean(h.iterations for h in records),
        "mean_inlier_share": _mean(h.inlier_share for h in records),
        "mean_rmse_m": _mean(h.rmse_m for h in records),
    }


def _write(
    export: Export,
    sequence: Sequence,
    poses: list[Tensor],
    records: list[Health],
    seconds: float,
    settings: Mapping[str, Any] | None,
) -> None:
    T_world = to_reference_frame(torch.stack(poses), sequence.T_reference_lidar)
    timestamps = None if sequence.timestamps is None else sequence.timestamps[: len(poses)]
    write_kitti_poses(export.kitti, T_world)
    write_tum_poses(export.tum, T_world, timestamps)
    write_health(export.health, records)
    speed = len(poses) / max(seconds, 1e-9)
    summary = {"frames_per_second": speed, "health": summarize_health(records), "settings": settings or {}}
    with atomic_write(export.summary) as draft:
        draft.write_text(json.dumps(summary, indent=2) + "\n", encoding="utf-8")


def _mean(values: Iterable[float | None]) -> float | None:
    known = [value for value in values if value is not None]
    return statistics.fmean(known) if known else None
