"""Sequences without scans, and trajectories to score on them."""

from collections.abc import Callable

import pytest
import torch
from torch import Tensor

from lidarlearn.data.sequence import Scan, Sequence
from lidarlearn.geometry import se3


class DriveWithoutScans(Sequence):
    """Ground truth alone: reading a scan fails."""

    def __init__(
        self,
        name: str,
        T_world_lidar: Tensor | None,
        frames: int,
        timestamps: Tensor | None = None,
        T_reference_lidar: Tensor | None = None,
    ):
        self.name = name
        self.frames = frames
        self.T_world_lidar = T_world_lidar
        self.timestamps = timestamps
        if T_reference_lidar is not None:
            self.T_reference_lidar = T_reference_lidar
            self.reference_frame = "camera"

    def __len__(self) -> int:
        return self.frames

    def scan(self, index: int) -> Scan:
        raise AssertionError("scoring reads no scan")

    @property
    def fingerprint(self) -> str:
        return self.name


@pytest.fixture(scope="session")
def T_camera_lidar() -> Tensor:
    """A camera as KITTI's: x right, y down, z forward, a little below and in front of the LiDAR."""
    T = se3.identity()
    T[:3, :3] = torch.tensor([[0.0, -1, 0], [0, 0, -1], [1, 0, 0]], dtype=torch.float64)
    T[:3, 3] = torch.tensor([0.0, -0.08, -0.27], dtype=torch.float64)
    return T @ se3.exp(torch.tensor([0, 0, 0, 0.002, -0.008, 0.01], dtype=torch.float64))


@pytest.fixture(scope="session")
def make_drive() -> Callable[..., Tensor]:
    """A smooth drive of one metre a frame on a winding road; starts at the identity."""

    def make(frames: int) -> Tensor:
        i = torch.arange(frames - 1, dtype=torch.float64)
        zero = torch.zeros_like(i)
        return se3.accumulate(se3.exp(torch.stack([zero + 1, zero, zero, zero, zero, 0.02 * (i / 30).sin()], dim=1)))

    return make


@pytest.fixture(scope="session")
def make_sequence(make_drive: Callable[..., Tensor]) -> Callable[..., DriveWithoutScans]:
    """A sequence of 10 Hz with ground truth."""

    def make(name: str, frames: int, T_reference_lidar: Tensor | None = None) -> DriveWithoutScans:
        times = 100 + 0.1 * torch.arange(frames, dtype=torch.float64)
        return DriveWithoutScans(name, make_drive(frames), frames, times, T_reference_lidar)

    return make


@pytest.fixture(scope="session")
def unknown_drive() -> DriveWithoutScans:
    """Five scans without ground truth or time stamps."""
    return DriveWithoutScans("unknown", None, 5)


@pytest.fixture(scope="session")
def longer() -> Callable[..., Tensor]:
    """The same drive with every motion too long by a share of itself."""

    def make(T_world: Tensor, share: float) -> Tensor:
        T_relative = se3.relative(T_world)
        T_relative[:, :3, 3] *= 1 + share
        return se3.accumulate(T_relative)

    return make
