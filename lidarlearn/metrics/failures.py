"""Registration failures: grossly wrong motions between consecutive scans."""

import math

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from lidarlearn.geometry import se3
from lidarlearn.metrics.checks import check_comparable

MAX_TRANSLATION_M = 1.0
MAX_ROTATION_DEG = 3.0


def registration_failures(
    T_estimate: Float[Tensor, "n 4 4"],
    T_ground_truth: Float[Tensor, "m 4 4"],
    max_translation_m: float = MAX_TRANSLATION_M,
    max_rotation_deg: float = MAX_ROTATION_DEG,
) -> Bool[Tensor, "p"]:
    """Whether each motion between consecutive scans is off by more than a metre or three degrees.

    Rotations are compared as vectors of Euler angles, as in the paper, not by the angle between them.

    Args:
        T_estimate: absolute poses of the LiDAR.
        T_ground_truth: the same number of poses.
        max_translation_m: largest error of the translation that is not a failure.
        max_rotation_deg: largest norm of the difference of Euler angles that is not a failure.

    Raises:
        ValueError: the numbers of poses differ, or poses are not finite.

    Source: Dellenbach et al. 2021, IV-D "Weaknesses of Geometric LiDAR Odometries".
    """
    check_comparable(T_estimate, T_ground_truth)
    difference = se3.to_euler(se3.relative(T_estimate)) - se3.to_euler(se3.relative(T_ground_truth))
    angles = torch.remainder(difference[:, 3:] + math.pi, 2 * math.pi) - math.pi  # -179 and 179 deg are 2 deg apart
    return (difference[:, :3].norm(dim=-1) > max_translation_m) | (angles.norm(dim=-1) > math.radians(max_rotation_deg))
