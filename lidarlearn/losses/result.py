"""What every loss returns."""

from dataclasses import dataclass

from jaxtyping import Float
from torch import Tensor


@dataclass(frozen=True)
class LossResult:
    """A loss and what it was made of.

    Args:
        loss: mean over the batch, differentiable.
        parts: what to watch besides, by name with its unit, without gradient.
    """

    loss: Float[Tensor, ""]
    parts: dict[str, Float[Tensor, ""]]
