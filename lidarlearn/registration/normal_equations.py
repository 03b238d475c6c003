"""Normal equations of one Gauss-Newton iteration, and how well they determine the position of a scan.

Six unknowns are solved with numpy on the CPU, in less time than a GPU needs to start, and three times as fast as with
torch.
"""

import functools
from dataclasses import dataclass, field

import numpy as np
import torch
from jaxtyping import Bool, Float, Float64
from torch import Tensor
from torch.nn.functional import pad

from lidarlearn.cuda_graphs import GraphCache
from lidarlearn.registration.association.base import Neighbours

# A residual is sensitive to a move of 1 m if it changes by more than this [m]: the sine of 17 deg, more than the error
# of nearly all normals.
_MIN_SENSITIVITY_M = 0.3
_EYE = np.eye(6)
_MEANS = np.kron(np.eye(2), np.full((3, 3), 1 / 3))  # (translation, rotation) -> the mean of each, three times


@dataclass(frozen=True)
class Terms:
    """Per-point quantities behind the normal equations, on the points' device.

    Args:
        neighbours: the nearest map points, for the next search.
        mask: which points have a neighbour with a normal.
        surface_distances_m: distance of each point from the map's surface at its neighbour [m].
        weights: robust weight of each point, 0 outside the mask.
        augmented_jacobians: [J r] of each point, see `Residual.linearize`.
        graphs: CUDA graphs of functions of these terms.
    """

    neighbours: Neighbours | None
    mask: Bool[Tensor, "*batch m"]
    surface_distances_m: Float[Tensor, "*batch m"]
    weights: Float[Tensor, "*batch m"]
    augmented_jacobians: Float[Tensor, "*batch m k 7"]
    graphs: GraphCache = field(default_factory=GraphCache)

    def sensitive_points(self, pose_directions: Float64[np.ndarray, "*batch 6 3"]) -> Float[np.ndarray, "*batch 3"]:
        """Weighted number of points whose residual changes noticeably under each of three moves of the pose."""
        moves, device = torch.from_numpy(pose_directions), self.weights.device
        return self.graphs(self._sensitive_points, moves, device=device, reads_first=True).numpy()

    def _sensitive_points(self, moves: Float[Tensor, "*batch 6 3"]) -> Float[Tensor, "*batch 3"]:
        jacobians = self.augmented_jacobians[..., :6]
        changes = jacobians.flatten(-3, -2) @ moves.to(jacobians)
        is_sensitive = (changes.abs() > _MIN_SENSITIVITY_M).to(changes).view(*jacobians.shape[:-1], 3).mean(-2)
        return (self.weights[..., None, :] @ is_sensitive)[..., 0, :]

    def phase_moments(self, phases: Float[Tensor, "n"]) -> Float64[np.ndarray, "2 *batch 7 7"]:
        """Augmented Hessians in which each point is also weighted by its phase, and by the square of its phase."""
        phases = pad(phases, (0, self.weights.shape[-1] - len(phases)))
        return self.graphs(self._phase_moments, phases, device=self.weights.device, reads_first=True).numpy().copy()

    def _phase_moments(self, phases: Float[Tensor, "m"]) -> Float64[Tensor, "2 *batch 7 7"]:
        jacobians, weights = self.augmented_jacobians.double(), self.weights * phases
        return torch.stack([augmented_hessian(jacobians, weights), augmented_hessian(jacobians, weights * phases)])


@dataclass(frozen=True)
class Localizability:
    """How well a scan determines its position, along the principal axes of the position's covariance.

    Args:
        covariance: inverse of the Hessian.
        directions: the axes, as unit columns, in descending order of the variance.
        pose_directions: the moves of the whole pose that cost least energy while the position moves by one along each
            axis.
        information: see `RegistrationResult.information`, but in the order of the axes.

    Source: after Zhang, Kaess & Singh, "On degeneracy of optimization-based state estimation problems", ICRA 2016.
    """

    covariance: Float64[np.ndarray, "*batch 6 6"]
    directions: Float64[np.ndarray, "*batch 3 3"]
    pose_directions: Float64[np.ndarray, "*batch 6 3"]
    information: Float[np.ndarray, "*batch 3"]


@dataclass(frozen=True)
class NormalEquations:
    """H xi = -g.

    Args:
        H: Hessian of half the weighted sum of squared residuals.
        g: gradient of the same.
        squares: the weighted sum of squared residuals [m^2].
        terms: the per-point quantities behind the sums.
        points: number of points, with or without a neighbour.
    """

    H: Float64[np.ndarray, "*batch 6 6"]
    g: Float64[np.ndarray, "*batch 6"]
    squares: Float64[np.ndarray, "*batch"]
    terms: Terms
    points: int

    @classmethod
    def of(cls, augmented_hessian: Float64[Tensor, "*batch 7 7"], terms: Terms, points: int) -> "NormalEquations":
        """The equations from their augmented Hessian, on the CPU."""
        H = augmented_hessian.numpy().copy()  # the next result may be written to the same memory
        return cls(H[..., :6, :6], H[..., :6, 6], H[..., 6, 6], terms, points)

    @functools.cached_property
    def localizability(self) -> Localizability:
        """How well they determine the position."""
        # The ridge keeps an empty system solvable. It is far below any information, but above the rounding errors of
        # the Jacobians, so that undetermined parameters keep their values, such as the yaw on a bare plane.
        ridge = np.diagonal(self.H, axis1=-2, axis2=-1) @ _MEANS * 1e-6 + 1e-9
        covariance = np.linalg.inv(self.H + ridge[..., None] * _EYE)
        negative_variances, directions = np.linalg.eigh(-covariance[..., :3, :3])
        pose_directions = covariance[..., :, :3] @ directions / -negative_variances[..., None, :]
        information = self.terms.sensitive_points(pose_directions) / max(self.points, 1)
        return Localizability(covariance, directions, pose_directions, information)


def augmented_hessian(
    augmented_jacobians: Float64[Tensor, "*batch m k 7"], weights: Float[Tensor, "*batch m"]
) -> Float64[Tensor, "*batch 7 7"]:
    """Sum of w [J r]^T [J r] over all points: the Hessian, the gradient beside it, and the squares in the corner.

    In double precision: in single, rounding would pass for information along directions that have none.
    """
    weighted = augmented_jacobians * weights[..., None, None]
    return weighted.flatten(-3, -2).mT @ augmented_jacobians.flatten(-3, -2)
