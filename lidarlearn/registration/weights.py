"""Robust weights of iteratively reweighted least squares.

Each is a small frozen class with one method, `weight`: from residuals and squared distances between the associated
points to weights in [0, 1]. The scale parameters are in metres.
"""

from abc import ABC, abstractmethod
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from lidarlearn.errors import require_positive


class RobustWeight(ABC):
    """How much a correspondence counts. Scales are in metres, have names that end in `_m`, and must be above 0."""

    def __post_init__(self) -> None:
        scales = {name: value for name, value in vars(self).items() if name.endswith("_m")}
        require_positive(f"weight {type(self).__name__}", **scales)

    @abstractmethod
    def weight(
        self, residuals: Float[Tensor, "*batch"], squared_distances: Float[Tensor, "*batch"]
    ) -> Float[Tensor, "*batch"]:
        """Weights in [0, 1] from residuals [m] and squared point-to-point distances [m^2]."""


@dataclass(frozen=True)
class NoWeight(RobustWeight):
    """Ordinary least squares."""

    def weight(self, residuals: Tensor, squared_distances: Tensor) -> Tensor:
        """One for every correspondence."""
        return torch.ones_like(residuals)


@dataclass(frozen=True)
class Proximity(RobustWeight):
    """exp(-|p - q|^2 / sigma^2): close pairs count, whatever their residual.

    Source: Dellenbach et al. 2021, III-A "Energy minimized", sigma 0.5 m.
    """

    sigma_m: float = 0.5

    def weight(self, residuals: Tensor, squared_distances: Tensor) -> Tensor:
        """The paper's weight."""
        return torch.exp(squared_distances * (-1 / self.sigma_m**2))


@dataclass(frozen=True)
class Huber(RobustWeight):
    """min(1, delta / |r|), as in SuMa."""

    delta_m: float = 0.1

    def weight(self, residuals: Tensor, squared_distances: Tensor) -> Tensor:
        """Quadratic up to delta, linear beyond."""
        return self.delta_m / residuals.abs().clamp(min=self.delta_m)


@dataclass(frozen=True)
class CutOff(RobustWeight):
    """One up to a residual of `threshold_m`, zero beyond, as in IMLS-SLAM (0.5 m)."""

    threshold_m: float = 0.5

    def weight(self, residuals: Tensor, squared_distances: Tensor) -> Tensor:
        """The hard cut."""
        return (residuals.abs() <= self.threshold_m).to(residuals.dtype)


@dataclass(frozen=True)
class GemanMcClure(RobustWeight):
    """(sigma^2 / (sigma^2 + r^2))^2: outliers fade quadratically, as in KISS-ICP."""

    sigma_m: float = 0.1

    def weight(self, residuals: Tensor, squared_distances: Tensor) -> Tensor:
        """The redescending weight."""
        return (self.sigma_m**2 / (self.sigma_m**2 + residuals * residuals)) ** 2


@dataclass(frozen=True)
class Cauchy(RobustWeight):
    """1 / (1 + (r / sigma)^2)."""

    sigma_m: float = 0.1

    def weight(self, residuals: Tensor, squared_distances: Tensor) -> Tensor:
        """The heavy-tailed weight."""
        return 1 / (1 + (residuals / self.sigma_m) ** 2)
