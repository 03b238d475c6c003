"""The height of the ground, whose gentle slopes a vehicle follows."""

from abc import ABC, abstractmethod

import numpy as np
from jaxtyping import Float
from scipy import ndimage


class Terrain(ABC):
    """Smooth ground, before roads, kerbs and embankments are cut into it."""

    @abstractmethod
    def height(self, xy: Float[np.ndarray, "*batch 2"]) -> Float[np.ndarray, "*batch"]:
        """Height of the ground at horizontal positions [m]."""


class Hills(Terrain):
    """A sum of waves of 30 to 300 m in random directions, defined everywhere.

    Args:
        rng: random generator of the waves.
        slope_deg: root mean square of the slope in any direction [deg]; 1 to 3 on KITTI's roads.
    """

    def __init__(self, rng: np.random.Generator, slope_deg: float) -> None:
        count = 8
        lengths = np.geomspace(30, 300, count)
        heading = rng.uniform(0, 2 * np.pi, count)
        # Long waves carry most of the slope, because short ones would shake the vehicle.
        share = (lengths / lengths.sum()) ** 0.5
        slopes = np.tan(np.radians(slope_deg)) * 2 * share / np.linalg.norm(share)
        self._wave = 2 * np.pi / lengths * np.stack([np.cos(heading), np.sin(heading)])
        self._phase = rng.uniform(0, 2 * np.pi, count)
        self._amplitude = slopes * lengths / (2 * np.pi)

    def height(self, xy: Float[np.ndarray, "*batch 2"]) -> Float[np.ndarray, "*batch"]:
        """Height of the ground at horizontal positions [m]."""
        return np.sin(xy @ self._wave + self._phase) @ self._amplitude


class GroundBelow(Terrain):
    """Smooth ground below a given path.

    Args:
        points: points of the path on the ground [m].
    """

    _CELL = 4.0
    _MARGIN = 250.0
    # Near the path, its own heights dominate; farther away, averages over wider and wider areas.
    _SIGMAS_AND_WEIGHTS = ((6.0, 1.0), (40.0, 1e-3), (200.0, 1e-6))

    def __init__(self, points: Float[np.ndarray, "n 3"]) -> None:
        self._origin = points[:, :2].min(axis=0) - self._MARGIN
        shape = np.ceil((points[:, :2].max(axis=0) + self._MARGIN - self._origin) / self._CELL).astype(int) + 1
        cell = np.round((points[:, :2] - self._origin) / self._CELL).astype(int)
        self._mean = points[:, 2].mean()
        heights, counts = np.zeros(shape), np.zeros(shape)
        np.add.at(heights, tuple(cell.T), points[:, 2] - self._mean)
        np.add.at(counts, tuple(cell.T), 1.0)
        total, weights = np.zeros(shape), np.full(shape, 1e-12)
        for sigma, weight in self._SIGMAS_AND_WEIGHTS:
            total += weight * ndimage.gaussian_filter(heights, sigma / self._CELL)
            weights += weight * ndimage.gaussian_filter(counts, sigma / self._CELL)
        self._grid = total / weights

    def height(self, xy: Float[np.ndarray, "*batch 2"]) -> Float[np.ndarray, "*batch"]:
        """Height of the ground at horizontal positions [m]."""
        cells = np.moveaxis((xy - self._origin) / self._CELL, -1, 0)
        return ndimage.map_coordinates(self._grid, cells, order=1, mode="nearest") + self._mean
