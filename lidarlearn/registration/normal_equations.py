"""Normal equations of one iteration, and what they say about the position of a scan.

Six unknowns are solved with numpy on the CPU: before a GPU had begun, and in a third of the time that torch takes for
arrays as small as these.
"""

from dataclasses import dataclass, field

import numpy as np
import torch
from jaxtyping import Bool, Float, Float64
from torch import Tensor
from torch.nn.functional import pad

from lidarlearn.cuda_graphs import Recordings
from lidarlearn.registration.association.base import Neighbours

# A residual notices a move of 1 m if it changes by more than this [m]: the sine of 17 deg, beyond the error of nearly
# all normals.
_NOTICEABLE = 0.3
_EYE = np.eye(6)
_MEANS = np.kron(np.eye(2), np.full((3, 3), 1 / 3))  # of the translation's three numbers, and of the rotation's


@dataclass(frozen=True)
class Terms:
    """What the points say, where they are: on their device.

    Args:
        found: the neighbours, for the next search.
        mask: which points have a neighbour with a normal.
        off_m: how far each of them is off the map's surface [m].
        weights: of each point.
        rows: derivatives of the residuals of each point and the residuals, side by side, see `Linearization`.
        recordings: of functions of these.
    """

    found: Neighbours | None
    mask: Bool[Tensor, "*batch m"]
    off_m: Float[Tensor, "*batch m"]
    weights: Float[Tensor, "*batch m"]
    rows: Float[Tensor, "*batch m k 7"]
    recordings: Recordings = field(default_factory=Recordings)

    def noticed(self, responses: Float64[np.ndarray, "*batch 6 3"]) -> Float[np.ndarray, "*batch 3"]:
        """Weighted number of points that notice each of three moves of the whole pose."""
        moves, device = torch.from_numpy(responses), self.weights.device
        return self.recordings(self._noticed, moves, device=device, reads_first=True).numpy()

    def _noticed(self, responses: Float[Tensor, "*batch 6 3"]) -> Float[Tensor, "*batch 3"]:
        moves = self.rows[..., :6].flatten(-3, -2) @ responses.to(self.rows)
        notices = (moves.abs() > _NOTICEABLE).to(moves).view(*self.rows.shape[:-1], 3).mean(-2)
        return (self.weights[..., None, :] @ notices)[..., 0, :]

    def moments(self, phases: Float[Tensor, "n"]) -> Float64[np.ndarray, "2 *batch 7 7"]:
        """Sums as those of the normal equations, with each point's weight times its phase, and times its square."""
        phases = pad(phases, (0, self.weights.shape[-1] - len(phases)))
        return self.recordings(self._moments, phases, device=self.weights.device, reads_first=True).numpy().copy()

    def _moments(self, phases: Float[Tensor, "m"]) -> Float64[Tensor, "2 *batch 7 7"]:
        rows, weights = self.rows.double(), self.weights * phases
        return torch.stack([weighted_sums(rows, weights), weighted_sums(rows, weights * phases)])


@dataclass(frozen=True)
class NormalEquations:
    """H xi = -g.

    Args:
        H: of the weighted half squares.
        g: gradient of the same.
        squares: sum of the weighted squares [m^2].
        terms: what they are made of.
        points: how many points were asked.
    """

    H: Float64[np.ndarray, "*batch 6 6"]
    g: Float64[np.ndarray, "*batch 6"]
    squares: Float64[np.ndarray, "*batch"]
    terms: Terms
    points: int


@dataclass(frozen=True)
class Position:
    """What the normal equations say about the position, along the axes of its covariance.

    Args:
        covariance: inverse of the Hessian.
        directions: the axes, unit columns, the least known first.
        responses: how the whole pose moves, at least energy, when the position moves by one along each axis.
        information: see `RegistrationResult.information`.
    """

    covariance: Float64[np.ndarray, "*batch 6 6"]
    directions: Float64[np.ndarray, "*batch 3 3"]
    responses: Float64[np.ndarray, "*batch 6 3"]
    information: Float[np.ndarray, "*batch 3"]


def weighted_sums(
    rows: Float64[Tensor, "*batch m k 7"], weights: Float[Tensor, "*batch m"]
) -> Float64[Tensor, "*batch 7 7"]:
    """Sums of w (J, r)^T (J, r) over all points: Hessian, gradient and squares of the energy side by side.

    In single precision, H would no longer tell "nothing is known" from its own rounding.
    """
    return (rows * weights[..., None, None]).flatten(-3, -2).mT @ rows.flatten(-3, -2)


def normal_equations(sums: Float64[Tensor, "*batch 7 7"], terms: Terms, points: int) -> NormalEquations:
    """The equations of so many points.

    Args:
        sums: see `weighted_sums`, on the CPU.
        terms: of the points, and perhaps of more that say nothing.
        points: how many there are.
    """
    H = sums.numpy().copy()  # in memory that the next sums will come to
    return NormalEquations(H[..., :6, :6], H[..., :6, 6], H[..., 6, 6], terms, points)


def position_of(equations: NormalEquations) -> Position:
    """What is known of the position, and how the whole pose follows it."""
    # A ridge far below any information keeps an empty system solvable, and above the rounding of the Jacobians it
    # holds what nothing is known of, such as the yaw on a bare plane.
    ridge = np.diagonal(equations.H, axis1=-2, axis2=-1) @ _MEANS * 1e-6 + 1e-9
    covariance = np.linalg.inv(equations.H + ridge[..., None] * _EYE)
    negative_variances, directions = np.linalg.eigh(-covariance[..., :3, :3])
    responses = covariance[..., :, :3] @ directions / -negative_variances[..., None, :]
    information = equations.terms.noticed(responses) / max(equations.points, 1)
    return Position(covariance, directions, responses, information)
