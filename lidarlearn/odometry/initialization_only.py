"""An odometry without registration."""

import torch

from lidarlearn.geometry import se3
from lidarlearn.odometry.base import BaseOdometry, Frame, Points, Times, as_scan
from lidarlearn.odometry.health import Health
from lidarlearn.odometry.initialization.base import Initialization


class InitializationOnly(BaseOdometry):
    """Chains the motions that an initialization guesses, without registration.

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
        """Move by the guessed motion."""
        points, _ = as_scan(points, times, self._device)
        guess = self._initialization.predict(points[points.isfinite().all(dim=1)], self._motion.clone())
        if self._frames:
            self._motion = guess.T_previous_new
            self._T_world_lidar = se3.orthonormalize(self._T_world_lidar @ self._motion)
        self._frames += 1
        health = Health(self._frames - 1, initialization=guess.source, points=len(points))
        return Frame(self._T_world_lidar.clone(), health)
