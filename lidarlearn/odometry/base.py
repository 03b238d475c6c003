"""The interface of odometries: scans in, poses out, one by one."""

from abc import ABC, abstractmethod
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from lidarlearn.odometry.health import Health

_MAX_TIME = 1.5  # of a point, in scan periods before or after the instant of the pose

# From users, so `as_scan` checks them: any number type, on any device, arrays in any memory order.
Points = Tensor | np.ndarray
Times = Tensor | np.ndarray


@dataclass(frozen=True)
class Frame:
    """The pose of a scan, and whether to trust it.

    Args:
        T_world_lidar: the pose, float64, on the CPU; the first one is the identity.
        health: the health record.
    """

    T_world_lidar: Float[Tensor, "4 4"]
    health: Health


class BaseOdometry(ABC):
    """Estimates the pose of each scan of a sequence, in order."""

    @abstractmethod
    def register_scan(self, points: Points, times: Times | None = None) -> Frame:
        """Find the pose of the next scan.

        Args:
            points: the scan (n, 3) [m], in the sensor's frame; may be empty or hold values that are not finite.
            times: time of each point (n,) from the instant of the pose, as a share of the scan period, e.g. -0.5 to
                0.5; see `lidarlearn.data.sequence.Scan`. Used to compensate the motion within the scan; points with
                other times are dropped. None: there is nothing to compensate.

        Raises:
            ValueError: the points are not (n, 3), the times are not (n,), or most times are not shares of a period.
        """


def as_scan(
    points: Points, times: Times | None, device: torch.device | None = None
) -> tuple[Float[Tensor, "n 3"], Float[Tensor, "n"] | None]:
    """Check points and times, and convert them to float32 tensors on one device, by default that of the points."""
    points = _as_tensor(points, device)
    if points.ndim != 2 or points.shape[1] != 3:
        raise ValueError(f"register_scan: points must be (n, 3), x y z [m], but are {tuple(points.shape)}")
    if times is None:
        return points, None
    times = _as_tensor(times, points.device)
    if times.shape != points.shape[:1]:
        raise ValueError(f"register_scan: times must be ({len(points)},) as the points, but are {tuple(times.shape)}")
    is_finite = times.isfinite()
    if 2 * are_shares_of_a_period(times).sum() < is_finite.sum():
        finite = times[is_finite]
        raise ValueError(
            "register_scan: times must be shares of the scan period, e.g. -0.5 at its beginning and 0.5 at its end, "
            f"but are {finite.min():g} to {finite.max():g}"
        )
    return points, times


def are_shares_of_a_period(times: Float[Tensor, "n"]) -> Bool[Tensor, "n"]:
    """Which times are possible for points of a scan, whichever of its instants the pose belongs to."""
    return times.abs() <= _MAX_TIME


def _as_tensor(values: Tensor | np.ndarray, device: torch.device | None) -> Tensor:
    if isinstance(values, np.ndarray):  # torch refuses reversed views, other byte orders and read-only arrays
        values = np.require(values, np.float32, ["C", "W"])
    return torch.as_tensor(values, dtype=torch.float32, device=device)
