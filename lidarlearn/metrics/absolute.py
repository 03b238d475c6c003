"""Absolute pose error (APE): distance between two trajectories after the best rigid alignment."""

import torch
from jaxtyping import Float
from torch import Tensor

from lidarlearn.geometry import se3
from lidarlearn.metrics.checks import check_comparable


def align(points_target: Float[Tensor, "n 3"], points_source: Float[Tensor, "n 3"]) -> Float[Tensor, "4 4"]:
    """`T_target_source` that aligns corresponding points best in the least-squares sense, without scale.

    Points on a line or in one place do not determine the rotation: one of the best is returned, always a proper one.

    Source: Umeyama, "Least-squares estimation of transformation parameters between two point patterns", PAMI 1991.
    """
    mean_target, mean_source = points_target.mean(0), points_source.mean(0)
    U, _, Vh = torch.linalg.svd((points_target - mean_target).mT @ (points_source - mean_source))
    signs = torch.ones_like(mean_target)
    signs[2] = torch.linalg.det(U @ Vh).sign()  # a reflection would fit mirrored paths better
    R = (U * signs) @ Vh
    return se3.from_rotation_translation(R, mean_target - R @ mean_source)


def absolute_errors(T_estimate: Float[Tensor, "n 4 4"], T_ground_truth: Float[Tensor, "m 4 4"]) -> Float[Tensor, "n"]:
    """Distance of each estimated position from the true one [m] after alignment of the whole trajectory.

    Raises:
        ValueError: the numbers of poses differ, or poses are not finite.
    """
    check_comparable(T_estimate, T_ground_truth)
    estimated, true = T_estimate[:, :3, 3], T_ground_truth[:, :3, 3]
    return (se3.transform(align(true, estimated), estimated) - true).norm(dim=-1)


def ape_rmse(T_estimate: Float[Tensor, "n 4 4"], T_ground_truth: Float[Tensor, "m 4 4"]) -> float | None:
    """Root mean square of `absolute_errors` [m]; None for fewer than two poses, which always align."""
    errors = absolute_errors(T_estimate, T_ground_truth)
    return float(errors.square().mean().sqrt()) if len(errors) > 1 else None
