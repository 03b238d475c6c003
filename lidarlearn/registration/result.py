"""The result of a registration."""

from dataclasses import dataclass

from jaxtyping import Bool, Float
from torch import Tensor


@dataclass(frozen=True)
class RegistrationResult:
    """The pose at which a scan fits the map, and measures of how well it fits.

    Tensors have the batch shape of the initial poses and are on the CPU.

    Args:
        T_world_lidar: the registered poses, float64.
        skew: motion over a scan period that remains after deskewing, as a twist (translation [m], rotation [rad]) in
            the sensor's frame, see `Elasticity`; zero if it was not estimated.
        iterations: number of Gauss-Newton steps; of a batch, those of the slowest.
        converged: whether the last step was below the tolerances, at the final search distance.
        overlap: share of the points that have a map neighbour with a normal within the search distance.
        inlier_share: share of these points whose distance d from the map's surface is below `inlier_residual_m`.
        fit: mean over all points of exp(-(d / fit_residual_m)^2), 0 for points without a neighbour. Sharper than the
            inlier share: it distinguishes the right pose from one close by.
        rmse_m: weighted root mean square of the residuals [m].
        hessian: of half the weighted sum of squared residuals, by (translation [m], rotation [rad]) in the sensor's
            frame.
        information: weighted share of all points whose residual changes noticeably when the position moves along each
            principal axis of its covariance, ascending. 0 along a corridor, where such a move changes no residual.
        weakest_direction: the axis with the least information, a unit vector in the sensor's frame.
    """

    T_world_lidar: Float[Tensor, "*batch 4 4"]
    skew: Float[Tensor, "*batch 6"]
    iterations: int
    converged: Bool[Tensor, "*batch"]
    overlap: Float[Tensor, "*batch"]
    inlier_share: Float[Tensor, "*batch"]
    fit: Float[Tensor, "*batch"]
    rmse_m: Float[Tensor, "*batch"]
    hessian: Float[Tensor, "*batch 6 6"]
    information: Float[Tensor, "*batch 3"]
    weakest_direction: Float[Tensor, "*batch 3"]
