"""Score a trajectory against the ground truth of its sequence, and average scores over sequences."""

import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field, fields
from typing import Any

from jaxtyping import Float
from torch import Tensor

from lidarlearn.data.sequence import Sequence
from lidarlearn.evaluation.trajectory_files import TrajectoryError, to_reference_frame
from lidarlearn.metrics import kitti
from lidarlearn.metrics.absolute import ape_rmse
from lidarlearn.metrics.failures import registration_failures
from lidarlearn.metrics.kitti import SegmentAverage
from lidarlearn.metrics.relative import relative_pose_error, relative_translation_error


@dataclass(frozen=True)
class Score:
    """One row of `results.json`: a method on a sequence. Undefined metrics are None, never 0.

    Trajectories (KITTI, APE, RPE) are compared in the frame in which the data set defines its poses; registrations
    (relative translation error, failures) in the LiDAR frame, in which they are made.

    Args:
        method: name of the method as in the paper, e.g. "cv+p_f2m".
        sequence: name of the sequence.
        frames: number of scans.
        path_length_m: length of the true path [m].
        segments: number of KITTI's segments of 100 to 800 m.
        avg_translation_error_percent: mean translation error of the segments, which the paper calls ATE [%].
        avg_rotation_error_deg_per_100m: mean rotation error of the segments [deg/100 m].
        ape_rmse_m: absolute pose error after rigid alignment, root mean square [m].
        rpe_translation_m: relative pose error between consecutive scans, root mean square [m].
        rpe_translation_mean_m: the same, mean [m].
        rpe_rotation_deg: angle of the relative pose error, root mean square [deg].
        relative_translation_error_percent: mean error of the motion between scans, relative to the mean motion [%].
        registration_failures: number of motions between scans with an error of more than 1 m or 3 deg.
        frames_per_second: speed of the odometry; None for trajectories of other tools.
        by_segment_length: mean errors over KITTI's segments of each length [m].
        health: summary of the odometry's health records.
    """

    method: str
    sequence: str
    frames: int
    path_length_m: float | None = None
    segments: int | None = None
    avg_translation_error_percent: float | None = None
    avg_rotation_error_deg_per_100m: float | None = None
    ape_rmse_m: float | None = None
    rpe_translation_m: float | None = None
    rpe_translation_mean_m: float | None = None
    rpe_rotation_deg: float | None = None
    relative_translation_error_percent: float | None = None
    registration_failures: int | None = None
    frames_per_second: float | None = None
    by_segment_length: Mapping[int, SegmentAverage] = field(default_factory=dict)
    health: Mapping[str, float | int | None] = field(default_factory=dict)


@dataclass(frozen=True)
class MeanOverSequences:
    """Means of a method's scores, with the same weight for every sequence.

    Args:
        sequences: number of sequences with KITTI segments, over which the two averages of KITTI's metric are taken.
        registration_failures: the sum over the sequences.

    The other fields are those of `Score`, each averaged over the sequences for which it is defined.
    """

    sequences: int
    avg_translation_error_percent: float | None
    avg_rotation_error_deg_per_100m: float | None
    ape_rmse_m: float | None
    rpe_translation_m: float | None
    rpe_translation_mean_m: float | None
    rpe_rotation_deg: float | None
    relative_translation_error_percent: float | None
    registration_failures: int | None
    frames_per_second: float | None


@dataclass(frozen=True)
class MeanOverSegments:
    """KITTI's metric over the pooled segments of all sequences, as in the benchmark's own table."""

    segments: int
    avg_translation_error_percent: float | None
    avg_rotation_error_deg_per_100m: float | None


@dataclass(frozen=True)
class Averages:
    """Both averages of a method: publications use either, and they are often confused."""

    method: str
    mean_over_sequences: MeanOverSequences
    mean_over_segments: MeanOverSegments


def score(
    method: str,
    T_world_lidar: Float[Tensor, "n 4 4"],
    sequence: Sequence,
    frames_per_second: float | None = None,
    health: Mapping[str, float | int | None] | None = None,
) -> Score:
    """Score the estimated poses of a method on a sequence. Without ground truth, every error is None.

    Args:
        method: name of the method.
        T_world_lidar: absolute poses of the LiDAR, one per scan; the first one is arbitrary.
        sequence: the sequence, with its ground truth; no scan is read.
        frames_per_second: speed of the method.
        health: summary of the odometry's health records.

    Raises:
        TrajectoryError: the numbers of poses and scans differ, or a pose is not finite.
    """
    _require_scorable(method, T_world_lidar, sequence)
    T_true = sequence.T_world_lidar
    if T_true is None:
        return Score(
            method, sequence.name, len(T_world_lidar), frames_per_second=frames_per_second, health=health or {}
        )
    T_world_estimate = to_reference_frame(T_world_lidar, sequence.T_reference_lidar)
    T_world_true = to_reference_frame(T_true, sequence.T_reference_lidar)
    errors = kitti.segment_errors(T_world_estimate, T_world_true)
    average = kitti.average(errors)
    rpe = relative_pose_error(T_world_estimate, T_world_true)
    motion_error = relative_translation_error(T_world_lidar, T_true)
    return Score(
        method=method,
        sequence=sequence.name,
        frames=len(T_world_lidar),
        path_length_m=float(kitti.path_distances(T_world_true)[-1]),
        segments=len(errors.length_m),
        avg_translation_error_percent=None if average is None else average.translation_percent,
        avg_rotation_error_deg_per_100m=None if average is None else average.rotation_deg_per_100m,
        ape_rmse_m=ape_rmse(T_world_estimate, T_world_true),
        rpe_translation_m=None if rpe is None else rpe.translation_rmse_m,
        rpe_translation_mean_m=None if rpe is None else rpe.translation_mean_m,
        rpe_rotation_deg=None if rpe is None else math.degrees(rpe.rotation_rmse_rad),
        relative_translation_error_percent=None if motion_error is None else 100 * motion_error,
        registration_failures=int(registration_failures(T_world_lidar, T_true).sum()) if len(T_true) > 1 else None,
        frames_per_second=frames_per_second,
        by_segment_length=kitti.average_by_length(errors),
        health=health or {},
    )


def average_scores(scores: Iterable[Score]) -> list[Averages]:
    """Both averages of every method, in order of first appearance."""
    by_method: dict[str, list[Score]] = {}
    for row in scores:
        by_method.setdefault(row.method, []).append(row)
    return [Averages(method, _over_sequences(rows), _over_segments(rows)) for method, rows in by_method.items()]


def pool_by_length(scores: list[Score]) -> dict[int, SegmentAverage]:
    """Mean errors by segment length [m], over the pooled segments of all sequences."""
    lengths = sorted({length for row in scores for length in row.by_segment_length})
    return {n: _pool([row.by_segment_length[n] for row in scores if n in row.by_segment_length]) for n in lengths}


def _pool(parts: list[SegmentAverage]) -> SegmentAverage:
    """The mean errors over all segments behind several averages."""
    count = sum(part.segments for part in parts)
    return SegmentAverage(
        segments=count,
        translation_percent=sum(part.segments * part.translation_percent for part in parts) / count,
        rotation_deg_per_100m=sum(part.segments * part.rotation_deg_per_100m for part in parts) / count,
    )


def _require_scorable(method: str, T_world_lidar: Tensor, sequence: Sequence) -> None:
    where = f"'{method}' on sequence {sequence.name}"
    if len(T_world_lidar) != len(sequence):
        raise TrajectoryError(
            f"{where}: {len(T_world_lidar)} poses for {len(sequence)} scans.\n"
            "  change: give one pose a scan; if scans were left out on purpose, set data.max_frames alike"
        )
    if not bool(T_world_lidar.isfinite().all()):
        first = int((~T_world_lidar.isfinite()).flatten(1).any(1).int().argmax())
        raise TrajectoryError(
            f"{where}: pose {first} is not finite.\n  change: this trajectory cannot be scored; run the method again"
        )


def _over_sequences(rows: list[Score]) -> MeanOverSequences:
    names = [entry.name for entry in fields(MeanOverSequences) if entry.name != "sequences"]
    defined = {name: [value for row in rows if (value := getattr(row, name)) is not None] for name in names}
    means: dict[str, Any] = {name: sum(values) / len(values) if values else None for name, values in defined.items()}
    means["sequences"] = sum(bool(row.segments) for row in rows)
    means["registration_failures"] = sum(defined["registration_failures"]) if defined["registration_failures"] else None
    return MeanOverSequences(**means)


def _over_segments(rows: list[Score]) -> MeanOverSegments:
    by_length = pool_by_length(rows)
    if not by_length:
        return MeanOverSegments(0, None, None)
    pooled = _pool(list(by_length.values()))
    return MeanOverSegments(pooled.segments, pooled.translation_percent, pooled.rotation_deg_per_100m)
