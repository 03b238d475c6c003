"""Training from ground truth."""

from jaxtyping import Float
from torch import Tensor

from lidarlearn.data.pairs import Pair
from lidarlearn.losses.result import LossResult
from lidarlearn.training.module import PoseNetModule


class SupervisedModule(PoseNetModule):
    """PoseNet trained to minimize the distance of its estimates to the true relative poses.

    Args: see `PoseNetModule`; the loss is the supervised one.

    Source: Dellenbach et al. 2021, III-B "Supervised training".
    """

    needs_ground_truth = True  # checked by the datamodule before training starts

    def compute_loss(self, parameters: Float[Tensor, "batch 6"], batch: Pair) -> LossResult:
        """Distance to the ground truth."""
        return self.loss(parameters, batch["T_ref_new"])
