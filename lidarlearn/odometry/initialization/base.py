"""The interface of initializations."""

from abc import ABC, abstractmethod
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor


@dataclass(frozen=True)
class InitialMotion:
    """A guess of the motion since the previous scan.

    Args:
        T_previous_new: the motion, float64, on the CPU like all poses of an odometry.
        source: name of the initialization that made the guess, which may be a fallback; only shown in the health
            record.
    """

    T_previous_new: Float[Tensor, "4 4"]
    source: str

    def __post_init__(self) -> None:
        T = self.T_previous_new
        is_pose = isinstance(T, Tensor) and T.shape == (4, 4) and T.dtype == torch.float64 and T.device.type == "cpu"
        if not is_pose or not T.isfinite().all():
            raise ValueError(
                f"initialization {self.source!r}: T_previous_new must be a finite (4, 4) tensor of float64 on the CPU, "
                f"but is {T}"
            )


class Initialization(ABC):
    """Guesses the motion of each new scan before it is registered; gets every scan once, in order."""

    @abstractmethod
    def predict(self, points: Float[Tensor, "n 3"], last_motion: Float[Tensor, "4 4"]) -> InitialMotion:
        """Guess the motion between the previous scan and this one.

        Args:
            points: the new scan [m], in the sensor's frame.
            last_motion: registered motion between the two previous scans; the identity if there is none yet.
        """
