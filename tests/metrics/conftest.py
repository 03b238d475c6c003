"""Trajectories that the tests of the metrics share."""

from collections.abc import Callable

import pytest
import torch
from torch import Tensor

from lidarlearn.geometry import se3


@pytest.fixture(scope="session")
def straight_line() -> Callable[..., Tensor]:
    """Poses along x, one every `step` metres, without rotation."""

    def make(metres: float, step: float = 1.0) -> Tensor:
        x = step * torch.arange(round(metres / step) + 1, dtype=torch.float64)
        T = se3.identity(len(x))
        T[:, 0, 3] = x
        return T

    return make


@pytest.fixture(scope="session")
def winding_drive() -> Callable[..., Tensor]:
    """A smooth drive on a winding, hilly road; starts at the identity."""

    def make(frames: int = 400, speed: float = 1.1) -> Tensor:
        i = torch.arange(frames - 1, dtype=torch.float64)
        zero = torch.zeros_like(i)
        yaw, pitch = 0.03 * (i / 40).sin(), 0.004 * (i / 25).cos()
        return se3.accumulate(se3.exp(torch.stack([speed + 0.4 * (i / 60).cos(), zero, zero, zero, pitch, yaw], dim=1)))

    return make


@pytest.fixture(scope="session")
def perturbed() -> Callable[..., Tensor]:
    """The same drive with a random error in every relative motion."""

    def make(T_world: Tensor, scale: float = 1.0, seed: int = 0) -> Tensor:
        generator = torch.Generator().manual_seed(seed)
        noise = torch.randn(len(T_world) - 1, 6, generator=generator, dtype=torch.float64)
        sigma = scale * torch.tensor([0.02, 0.01, 0.01, 4e-4, 4e-4, 1e-3], dtype=torch.float64)
        return se3.accumulate(se3.relative(T_world) @ se3.exp(sigma * noise))

    return make
