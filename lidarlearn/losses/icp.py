"""The paper's ICP loss."""

from jaxtyping import Float
from torch import Tensor

from lidarlearn.losses.projective import ProjectiveLoss


class IcpLoss(ProjectiveLoss):
    """Absolute point-to-plane distance: rho = |r|.

    Args:
        normal_window: rows and columns of the neighbourhood of reference normals [px], odd.
        max_range_jump: see `normal_map`.
        max_roughness: see `normal_map`.

    Source: Dellenbach et al. 2021, III-B "Unsupervised training".
    """

    def rho(
        self, residuals: Float[Tensor, "*batch"], squared_distances: Float[Tensor, "*batch"]
    ) -> Float[Tensor, "*batch"]:
        """|r| of each correspondence [m]."""
        return residuals.abs()
