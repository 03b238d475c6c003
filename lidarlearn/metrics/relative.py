"""Relative pose error (RPE): errors of the motions between consecutive scans."""

from dataclasses import dataclass

from jaxtyping import Float
from torch import Tensor

from lidarlearn.geometry import se3
from lidarlearn.metrics.checks import check_comparable


@dataclass(frozen=True)
class RelativeErrors:
    """Error of each motion between consecutive scans; entry i belongs to scans i and i + 1.

    Args:
        translation: length of the error's translation [m].
        rotation: angle of the error's rotation [rad].
    """

    translation: Float[Tensor, "m"]
    rotation: Float[Tensor, "m"]


@dataclass(frozen=True)
class RelativePoseError:
    """Relative pose error (RPE) of a whole trajectory, over all consecutive pairs."""

    translation_rmse_m: float
    translation_mean_m: float
    rotation_rmse_rad: float


def relative_errors(T_estimate: Float[Tensor, "n 4 4"], T_ground_truth: Float[Tensor, "m 4 4"]) -> RelativeErrors:
    """Translation and angle of the inverse of the true `T_i_(i+1)` times the estimated one, for all consecutive pairs.

    The angle is that of the logarithm: the arc cosine of the trace is zero below 1e-4 rad in single precision, and
    noisy above it for poses with few digits.

    Raises:
        ValueError: the numbers of poses differ, or poses are not finite.
    """
    check_comparable(T_estimate, T_ground_truth)
    T_error = se3.inverse(se3.relative(T_ground_truth)) @ se3.relative(T_estimate)
    return RelativeErrors(translation=T_error[:, :3, 3].norm(dim=-1), rotation=se3.rotation_angle(T_error))


def relative_pose_error(
    T_estimate: Float[Tensor, "n 4 4"], T_ground_truth: Float[Tensor, "m 4 4"]
) -> RelativePoseError | None:
    """RPE over all consecutive pairs; None if there are none."""
    errors = relative_errors(T_estimate, T_ground_truth)
    if not len(errors.translation):
        return None
    return RelativePoseError(
        translation_rmse_m=float(errors.translation.square().mean().sqrt()),
        translation_mean_m=float(errors.translation.mean()),
        rotation_rmse_rad=float(errors.rotation.square().mean().sqrt()),
    )


def relative_translation_error(
    T_estimate: Float[Tensor, "n 4 4"], T_ground_truth: Float[Tensor, "m 4 4"]
) -> float | None:
    """Mean error of the translation between consecutive scans as a share of the mean motion; None without motion.

    Unlike KITTI's metric it is also defined for drives under 100 m. 0 is perfect; standing still scores 1.
    """
    check_comparable(T_estimate, T_ground_truth)
    true = se3.relative(T_ground_truth)[:, :3, 3]
    motion = float(true.norm(dim=-1).sum())
    error = float((se3.relative(T_estimate)[:, :3, 3] - true).norm(dim=-1).sum())
    return error / motion if motion > 0 else None


def speeds(T_world: Float[Tensor, "n 4 4"], timestamps: Float[Tensor, "n"]) -> Float[Tensor, "m"]:
    """Speed between consecutive poses [m/s]; pairs whose timestamps [s] do not ascend are left out."""
    elapsed = timestamps.diff()
    motion = T_world[:, :3, 3].diff(dim=0).norm(dim=-1)
    return motion[elapsed > 0] / elapsed[elapsed > 0]
