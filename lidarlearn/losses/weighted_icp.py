"""The paper's weighted ICP loss."""

from collections.abc import Sequence

from jaxtyping import Float
from torch import Tensor

from lidarlearn.losses.projective import ProjectiveLoss


class WeightedIcpLoss(ProjectiveLoss):
    """Weighted squared point-to-plane distance: rho = w r^2 with w = exp(-|p - q|^2 / sigma^2).

    The weight expresses confidence in an association. It has no gradient, as in the iteratively reweighted least
    squares of the registration: otherwise a correspondence farther apart than sigma would lower its cost by moving
    away. Trained on KITTI 04 with that gradient, the network settles on no motion at all.

    Args:
        sigma_m: distance at which an association weighs 1/e [m].
        normal_window: rows and columns of the neighbourhood of reference normals [px], odd.
        max_range_jump: see `normal_map`.
        max_roughness: see `normal_map`.

    Source: Dellenbach et al. 2021, III-B "Unsupervised training"; weights as in III-A "Energy minimized".
    """

    def __init__(
        self,
        sigma_m: float = 0.5,
        normal_window: Sequence[int] = (3, 3),
        max_range_jump: float = 0.15,
        max_roughness: float = 0.2,
    ) -> None:
        super().__init__(normal_window, max_range_jump, max_roughness)
        self.sigma_m = sigma_m

    def rho(
        self, residuals: Float[Tensor, "*batch"], squared_distances: Float[Tensor, "*batch"]
    ) -> Float[Tensor, "*batch"]:
        """W r^2 of each correspondence [m^2]."""
        weights = (-squared_distances.detach() / self.sigma_m**2).exp()
        return weights * residuals * residuals
