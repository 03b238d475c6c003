"""Training from scans alone."""

from jaxtyping import Float
from lightning.pytorch.utilities import rank_zero_warn
from torch import Tensor

from lidarlearn.data.pairs import Pair
from lidarlearn.losses.result import LossResult
from lidarlearn.training.module import PoseNetModule

LEAST_ACTIVATED_SHARE = 0.02
"""Share of used pixels below which the first batch of a training makes it warn; HDL-64 scans have about 0.4."""


class UnsupervisedModule(PoseNetModule):
    """PoseNet trained by how well its estimates align the scans themselves.

    Args: see `PoseNetModule`; the loss is one of the projective ones.

    Source: Dellenbach et al. 2021, III-B "Unsupervised training".
    """

    def compute_loss(self, parameters: Float[Tensor, "batch 6"], batch: Pair) -> LossResult:
        """Point-to-plane alignment of the target with the reference."""
        result = self.loss(parameters, batch["reference"], batch["target"], self.projection)
        if self.training and self.global_step == 0 and result.parts["activated_share"] < LEAST_ACTIVATED_SHARE:
            p = self.projection
            rank_zero_warn(
                f"only {100 * float(result.parts['activated_share']):.1f} % of the {p.height}x{p.width} pixels hold a "
                f"point of both scans and a normal: nothing can be learned from so few. Do scans fill an image of this "
                f"size and field of view ({p.fov_up_deg:g} to {p.fov_down_deg:g} deg)? Change datamodule.height, "
                "datamodule.width or data.projection"
            )
        return result
