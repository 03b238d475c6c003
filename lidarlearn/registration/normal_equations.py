"""Normal equations of one iteration, and what they say about the position of a scan."""

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from lidarlearn.registration.association.base import Neighbours

# A residual notices a move of 1 m if it changes by more than this [m]: the sine of 17 deg, beyond the error of nearly
# all normals.
_NOTICEABLE = 0.3


@dataclass(frozen=True)
class NormalEquations:
    """H xi = -g, and the correspondences that the equations were made of.

    Args:
        H: on the CPU, as g and the squares: six unknowns are solved there before a GPU has begun.
        g: gradient of the weighted half squares.
        squares: sum of the weighted squares [m^2].
        found: the neighbours, for the next search.
        mask: which points have a neighbour with a normal.
        off_m: how far each of them is off the map's surface [m].
        weights: of each point.
        jacobians: of the residuals of each point.
    """

    H: Float[Tensor, "*batch 6 6"]
    g: Float[Tensor, "*batch 6"]
    squares: Float[Tensor, "*batch"]
    found: Neighbours | None
    mask: Bool[Tensor, "*batch m"]
    off_m: Float[Tensor, "*batch m"]
    weights: Float[Tensor, "*batch m"]
    jacobians: Float[Tensor, "*batch m k 6"]


@dataclass(frozen=True)
class Position:
    """What the normal equations say about the position, along the axes of its covariance.

    Args:
        covariance: inverse of the Hessian.
        directions: the axes, unit columns, the least known first.
        responses: how the whole pose moves, at least energy, when the position moves by one along each axis.
        information: see `RegistrationResult.information`.
    """

    covariance: Float[Tensor, "*batch 6 6"]
    directions: Float[Tensor, "*batch 3 3"]
    responses: Float[Tensor, "*batch 6 3"]
    information: Float[Tensor, "*batch 3"]


def position_of(equations: NormalEquations) -> Position:
    """What is known of the position, and how the whole pose follows it."""
    # A ridge far below any information keeps an empty system solvable, and above the rounding of the Jacobians it
    # holds what nothing is known of, such as the yaw on a bare plane.
    H = equations.H.clone()
    diagonal = H.diagonal(dim1=-2, dim2=-1).unflatten(-1, (2, 3))  # of translation and of rotation
    diagonal += 1e-6 * diagonal.mean(-1, keepdim=True) + 1e-9
    covariance = torch.linalg.inv(H)
    negative_variances, directions = torch.linalg.eigh(-covariance[..., :3, :3])
    responses = covariance[..., :, :3] @ directions / -negative_variances[..., None, :]
    return Position(covariance, directions, responses, _information(equations, responses))


def _information(equations: NormalEquations, responses: Float[Tensor, "*batch 6 3"]) -> Float[Tensor, "*batch 3"]:
    """See `RegistrationResult.information`."""
    moves = equations.jacobians.flatten(-3, -2) @ responses.to(equations.jacobians)
    notices = (moves.abs() > _NOTICEABLE).to(moves).view(*equations.jacobians.shape[:-1], 3).mean(-2)
    share = (equations.weights[..., None, :] @ notices)[..., 0, :] / max(equations.weights.shape[-1], 1)
    return share.double().cpu()
