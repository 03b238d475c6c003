"""The interface of odometries: scans in, one by one, poses out."""

from abc import ABC, abstractmethod
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from lidarlearn.geometry import se3
from lidarlearn.odometry.health import Health
from lidarlearn.odometry.initialization.base import Initialization


@dataclass(frozen=True)
class Frame:
    """The pose of a scan, and whether to trust it.

    Args:
        T_world_lidar: the pose, float64, on the CPU; the first one is the identity.
        health: the health record.
    """

    T_world_lidar: Float[Tensor, "4 4"]
    health: Health


_MAX_TIME = 1.5  # of a point, in scan periods before or after the instant of the pose

# Of any number type, on any device, arrays in any memory order. They come from users, so `as_scan` checks them.
Points = Tensor | np.ndarray
Times = Tensor | np.ndarray


class ScanByScan(ABC):
    """Takes scans in order and estimates where they were taken."""

    @abstractmethod
    def register_scan(self, points: Points, times: Times | None = None) -> Frame:
        """Find the pose of the next scan.

        Args:
            points: the scan (n, 3) [m], in the sensor's frame; may be empty or hold values that are not finite.
            times: time of each point (n,), to compensate the motion within the scan: from the instant of the pose, as a
                share of the scan period, e.g. -0.5 to 0.5; see `lidarlearn.data.sequence.Scan`. Points with other times
                are left out. None: there is nothing to compensate.

        Raises:
            ValueError: the points are not (n, 3), there are more or fewer times than points, or most of the times are
                not shares of a scan period.
        """


def as_scan(
    points: Points, times: Times | None, device: torch.device | None = None
) -> tuple[Float[Tensor, "n 3"], Float[Tensor, "n"] | None]:
    """Check points and times; both as float32 tensors on one device, by default that of the points."""
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
    """Which times are possible for points of one scan, at whatever instant of it the pose is."""
    return times.abs() <= _MAX_TIME


def _as_tensor(values: Tensor | np.ndarray, device: torch.device | None) -> Tensor:
    if isinstance(values, np.ndarray):  # torch refuses views that are reversed, in another byte order, or read-only
        values = np.require(values, np.float32, ["C", "W"])
    return torch.as_tensor(values, dtype=torch.float32, device=device)


class InitializationAlone(ScanByScan):
    """Accumulates the guesses of an initialization, without any registration.

    Args:
        initialization: guesses the motion.
        device: where it runs.
    """

    def __init__(self, initialization: Initialization, device: torch.device | str = "cpu") -> None:
        self._initialization = initialization
        self._device = torch.device(device)
        self._motion = se3.identity()
        self._T_world_lidar = se3.identity()
        self._frames = 0

    def register_scan(self, points: Points, times: Times | None = None) -> Frame:
        """The previous pose and the guessed motion."""
        points, _ = as_scan(points, times, self._device)
        guess = self._initialization.predict(points[points.isfinite().all(dim=1)], self._motion.clone())
        if self._frames:
            self._motion = guess.T_previous_new
            self._T_world_lidar = se3.orthonormalize(self._T_world_lidar @ self._motion)
        self._frames += 1
        health = Health(self._frames - 1, initialization=guess.source, points=len(points))
        return Frame(self._T_world_lidar.clone(), health)
