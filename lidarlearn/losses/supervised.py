"""Supervised training: distance to the true relative pose, translation against rotation weighed by learning."""

import torch
from jaxtyping import Float
from torch import Tensor, nn

from lidarlearn.geometry import se3
from lidarlearn.losses.result import LossResult


class SupervisedLoss(nn.Module):
    """|t_gt - t|^2 e^{s1} + |e_gt - e|^2 e^{s2} - (s1 + s2) with learned s1, s2.

    For a given mean squared error m the best s is -ln m: the network learns the precision of either half, and each
    contributes about one whatever its unit. The price is a loss without lower bound, which falls by ln(1/m) for ever
    as the errors do (its sign means nothing, only its course). On a pair learned by heart s would grow until e^s
    overflows, hence the largest precision; in training s is put back to it, from where it can fall again.

    Args:
        initial_s1: s1 at the start; 0 suits errors of a metre.
        initial_s2: s2 at the start; 6 suits errors of 0.05 rad.
        max_s: s grows no larger; 14 stands for errors of 1 mm and 1 mrad.

    Source: Dellenbach et al. 2021, III-B "Supervised training", after LO-Net (Li et al., CVPR 2019).
    """

    def __init__(self, initial_s1: float = 0.0, initial_s2: float = 6.0, max_s: float = 14.0) -> None:
        super().__init__()
        self.s1 = nn.Parameter(torch.tensor(float(initial_s1)))
        self.s2 = nn.Parameter(torch.tensor(float(initial_s2)))
        self.max_s = max_s

    def forward(self, parameters: Float[Tensor, "batch 6"], T_ref_new: Float[Tensor, "batch 4 4"]) -> LossResult:
        """How far estimates are from the truth, averaged over the batch.

        Args:
            parameters: the network's estimate of `T_ref_new`: translation [m] and Euler angles [rad].
            T_ref_new: the true relative poses.
        """
        errors = se3.to_euler(T_ref_new).to(parameters.dtype) - parameters
        translation = errors[:, :3].square().sum(dim=1).mean()
        rotation = errors[:, 3:].square().sum(dim=1).mean()
        if self.training:
            with torch.no_grad():
                self.s1.clamp_(max=self.max_s)
                self.s2.clamp_(max=self.max_s)
        return LossResult(
            loss=translation * self.s1.exp() + rotation * self.s2.exp() - (self.s1 + self.s2),
            parts={
                "translation_squared_m2": translation.detach(),
                "rotation_squared_rad2": rotation.detach(),
                "s1": self.s1.detach().clone(),
                "s2": self.s2.detach().clone(),
            },
        )
