"""Supervised training: distance to the true relative pose, with learned weights of translation and rotation."""

import torch
from jaxtyping import Float
from torch import Tensor, nn

from lidarlearn.geometry import se3
from lidarlearn.losses.result import LossResult


class SupervisedLoss(nn.Module):
    """|t_gt - t|^2 e^{s1} + |e_gt - e|^2 e^{s2} - (s1 + s2) with learned s1, s2.

    For a mean squared error m the optimal s is -ln m, so that each term contributes about one whatever its unit. The
    price is a loss without a lower bound, which keeps falling by ln(1/m) as the errors do: only its course is
    meaningful, not its sign. On memorized pairs s would grow until e^s overflows, so training clamps it to `max_s`,
    from where it can fall again.

    Args:
        initial_s1: initial s1; 0 suits errors of a metre.
        initial_s2: initial s2; 6 suits errors of 0.05 rad.
        max_s: upper bound of both; 14 corresponds to errors of 1 mm and 1 mrad.

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
