"""Validation: the network as an odometry over the validation sequences."""

from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from lidarlearn.data.sequence import Sequence
from lidarlearn.evaluation.trajectory_files import to_reference_frame
from lidarlearn.geometry import se3
from lidarlearn.metrics import kitti
from lidarlearn.metrics.relative import relative_errors, relative_translation_error


@dataclass(frozen=True)
class PredictedDrive:
    """The trajectory of a validation sequence as predicted, up to the first scan without a prediction.

    Args:
        name: of the sequence.
        T_world_lidar: accumulated predictions, float64; the first pose is the identity.
        T_world_lidar_true: ground truth of the same scans; None if there is none.
        T_reference_lidar: from the LiDAR to the frame in which the data set defines its metric.
    """

    name: str
    T_world_lidar: Float[Tensor, "n 4 4"]
    T_world_lidar_true: Float[Tensor, "n 4 4"] | None
    T_reference_lidar: Float[Tensor, "4 4"]


@dataclass(frozen=True)
class DriveErrors:
    """Errors of a predicted drive.

    Args:
        avg_translation_error_percent: KITTI's metric; None for a drive under 100 m.
        mean_relative_translation_error_m: mean error of the translation between consecutive scans.
        mean_relative_translation_error_percent: the same as a share of the mean motion; None without motion.
        mean_relative_rotation_error_deg: mean error angle of the rotation between consecutive scans.
    """

    avg_translation_error_percent: float | None
    mean_relative_translation_error_m: float
    mean_relative_translation_error_percent: float | None
    mean_relative_rotation_error_deg: float


def predicted_drive(sequence: Sequence, indices: Tensor, parameters: Float[Tensor, "m 6"]) -> PredictedDrive:
    """Accumulate predictions in the order of the scans.

    Args:
        sequence: the drive.
        indices: of the reference scan of each prediction, in any order; may repeat.
        parameters: translation [m] and Euler angles [rad] of each `T_ref_new`.
    """
    indices, order = indices.cpu().sort(stable=True)
    first = torch.cat([indices.new_ones(min(len(indices), 1)), indices.diff()]) != 0
    indices, order = indices[first], order[first]
    unbroken = int((indices == torch.arange(len(indices))).sum())
    poses = se3.accumulate(se3.from_euler(parameters.detach().cpu().double()[order[:unbroken]]))
    truth = sequence.T_world_lidar
    return PredictedDrive(
        sequence.name, poses, None if truth is None else truth[: len(poses)], sequence.T_reference_lidar
    )


def drive_errors(drive: PredictedDrive) -> DriveErrors | None:
    """Errors against ground truth; None without ground truth or with fewer than two poses."""
    if drive.T_world_lidar_true is None or len(drive.T_world_lidar) < 2:
        return None
    relative = relative_errors(drive.T_world_lidar, drive.T_world_lidar_true)
    share = relative_translation_error(drive.T_world_lidar, drive.T_world_lidar_true)
    estimate, truth = (
        to_reference_frame(T, drive.T_reference_lidar) for T in (drive.T_world_lidar, drive.T_world_lidar_true)
    )
    segments = kitti.average(kitti.segment_errors(estimate, truth))
    return DriveErrors(
        avg_translation_error_percent=None if segments is None else segments.translation_percent,
        mean_relative_translation_error_m=float(relative.translation.mean()),
        mean_relative_translation_error_percent=None if share is None else 100 * share,
        mean_relative_rotation_error_deg=float(relative.rotation.mean().rad2deg()),
    )


def mean_errors(errors: list[DriveErrors]) -> dict[str, float]:
    """Mean of each error over the drives for which it is defined, by name; errors defined for none are left out."""
    means: dict[str, float] = {}
    for name in DriveErrors.__dataclass_fields__:
        values = [value for value in (getattr(e, name) for e in errors) if value is not None]
        if values:
            means[name] = sum(values) / len(values)
    return means
