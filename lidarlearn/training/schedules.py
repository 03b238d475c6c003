"""Learning-rate schedules that are updated every step."""

import math

from torch.optim import Optimizer
from torch.optim.lr_scheduler import LambdaLR


class WarmUpCosine(LambdaLR):
    """Rises linearly to the optimizer's learning rate, then falls along half a cosine to zero at the last step.

    A resumed training follows the schedule for its own number of steps, even if that has changed.

    Args:
        optimizer: the one whose learning rate is set.
        total_steps: of the whole training; filled in by `PoseNetModule`.
        warm_up_share: share of the steps during which the rate rises.
        start_share: rate at the first step, as a share of the optimizer's.

    Source: the fall after Loshchilov & Hutter, "SGDR", ICLR 2017.
    """

    def __init__(
        self, optimizer: Optimizer, total_steps: int, warm_up_share: float = 0.2, start_share: float = 0.1
    ) -> None:
        warm_up_steps = max(1.0, warm_up_share * total_steps)

        def share(step: int) -> float:
            if step < warm_up_steps:
                return start_share + (1 - start_share) * step / warm_up_steps
            progress = (step - warm_up_steps) / max(1.0, total_steps - warm_up_steps)
            return 0.5 * (1 + math.cos(math.pi * min(1.0, progress)))

        super().__init__(optimizer, share)
