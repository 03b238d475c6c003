"""What every loss returns."""

from dataclasses import dataclass

from jaxtyping import Float
from torch import Tensor


@dataclass(frozen=True)
class LossResult:
    """A loss and quantities to log beside it.

    Args:
        loss: mean over the batch, differentiable.
        parts: quantities to log, by name with unit, without gradient.
    """

    loss: Float[Tensor, ""]
    parts: dict[str, Float[Tensor, ""]]
