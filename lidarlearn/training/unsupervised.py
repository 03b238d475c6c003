"""Training from scans alone."""

from jaxtyping import Float
from torch import Tensor

from lidarlearn.data.pairs import Pair
from lidarlearn.losses.result import LossResult
from lidarlearn.training.module import PoseNetModule


class UnsupervisedModule(PoseNetModule):
    """PoseNet trained by how well its estimates align the scans themselves.

    Args: see `PoseNetModule`; the loss is one of the projective ones.

    Source: Dellenbach et al. 2021, III-B "Unsupervised training".
    """

    def compute_loss(self, parameters: Float[Tensor, "batch 6"], batch: Pair) -> LossResult:
        """Point-to-plane alignment of the target with the reference."""
        return self.loss(parameters, batch["reference"], batch["target"], self.projection)
