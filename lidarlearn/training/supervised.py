"""Training from ground truth."""

from jaxtyping import Float
from torch import Tensor

from lidarlearn.data.pairs import Pair
from lidarlearn.errors import UserError
from lidarlearn.losses.result import LossResult
from lidarlearn.training.module import PoseNetModule


class SupervisedModule(PoseNetModule):
    """PoseNet trained to minimize the distance of its estimates to the true relative poses.

    Args: see `PoseNetModule`; the loss is the supervised one.

    Source: Dellenbach et al. 2021, III-B "Supervised training".
    """

    needs_ground_truth = True  # checked by the datamodule before training starts

    def compute_loss(self, parameters: Float[Tensor, "batch 6"], batch: Pair) -> LossResult:
        """Distance to the ground truth.

        Raises:
            UserError: a sequence has no ground truth.
        """
        if "T_ref_new" not in batch:
            raise UserError(
                "loss=supervised needs ground truth, and not all of the training and validation sequences have it.\n"
                "  change: data.train_sequences and data.val_sequences to those that do, or loss=weighted_icp"
            )
        return self.loss(parameters, batch["T_ref_new"])
