"""What a registration says."""

from dataclasses import dataclass

from jaxtyping import Bool, Float
from torch import Tensor


@dataclass(frozen=True)
class RegistrationResult:
    """Where a scan fits, and how well: enough to judge an alignment instead of trusting it.

    Tensors share the batch shape of the initial poses, and are on the CPU as poses are.

    Args:
        T_world_lidar: the registered poses, float64.
        skew: motion over the scan period that the compensation of the points left over, as a twist of (translation
            [m], rotation [rad]) in the sensor's frame, see `Elasticity`; zero where none was looked for.
        iterations: Gauss-Newton steps taken, those of the slowest of a batch.
        converged: whether the last step was below the tolerances, at the final search distance.
        overlap: share of the points that have a map neighbour with a normal within the search distance.
        inlier_share: share of those whose distance d from the map's surface is below `inlier_residual_m`.
        fit: mean over all points of exp(-(d / fit_residual_m)^2), 0 for those without a neighbour: sharper than the
            inlier share, it tells the right pose from its neighbours.
        rmse_m: weighted root mean square of the residuals [m].
        hessian: of the weighted half squares by (translation [m], rotation [rad]) in the sensor's frame.
        information: weighted share of all points that notice a move along each of the three axes of the position's
            covariance, ascending: 0 along a corridor, where no residual changes however the pose follows.
        weakest_direction: unit vector, in the sensor's frame, of the smallest of them.
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
