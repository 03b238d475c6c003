"""Spinning LiDARs: the directions of their rays, and how they measure true distances."""

import math
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, UInt16

# Ranges are reported in steps of 2 mm (HDL-64E manual), which makes a range image 16 bit: up to 131 m.
RANGE_STEP = 0.002

_GOLDEN_RATIO = (1 + math.sqrt(5)) / 2


@dataclass(frozen=True)
class Sensor:
    """A spinning LiDAR. Rows of its images are beams from top to bottom, columns azimuths from the rear over the left.

    Args:
        name: name of the model.
        elevations_deg: angle of each beam above the horizon, the highest first [deg].
        columns: firings per revolution.
        period: duration of a revolution [s].
        min_range: nearest reported distance [m].
        max_range: farthest reported distance [m], at most 131 m.
        range_noise: standard deviation of the distances [m].
        drop_out: share of the returns lost at random.
        reach: distance at which half of the returns from a surface hit at a right angle are lost [m]. The signal
            falls with the square of the distance and with the cosine of the angle of incidence, so that roads fade
            out long before walls do. Infinity switches this off.
    """

    name: str
    elevations_deg: tuple[float, ...]
    columns: int
    period: float = 0.1
    min_range: float = 1.0
    max_range: float = 120.0
    range_noise: float = 0.02
    drop_out: float = 0.02
    reach: float = 300.0

    def __post_init__(self) -> None:
        if not 0 <= self.min_range < self.max_range <= RANGE_STEP * np.iinfo(np.uint16).max:
            raise ValueError(f"a sensor needs 0 <= min_range < max_range <= 131 m, got {self}")
        if self.columns < 1 or self.range_noise < 0 or not 0 <= self.drop_out <= 1 or self.reach <= 0:
            raise ValueError(
                f"a sensor needs columns >= 1, range_noise >= 0, drop_out in [0, 1], reach > 0, got {self}"
            )

    @property
    def beams(self) -> int:
        """Number of beams."""
        return len(self.elevations_deg)

    def column_times(self) -> Float[np.ndarray, "columns"]:
        """Time of each column relative to the middle of the sweep, in periods: [-0.5, 0.5)."""
        return np.arange(self.columns) / self.columns - 0.5

    def azimuths(self, index: int) -> Float[np.ndarray, "columns"]:
        """Azimuth of each column of scan `index` [rad], decreasing from pi (rear) over 0 (forward) to -pi.

        The firings are not synchronized with the revolution: from scan to scan they shift by a fraction of a column.
        """
        shift = (index / _GOLDEN_RATIO) % 1
        return math.pi - 2 * math.pi * (np.arange(self.columns) + shift) / self.columns

    def directions(
        self, index: int, R_world_column: Float[np.ndarray, "#columns 3 3"] | None = None
    ) -> Float[np.ndarray, "beams columns 3"]:
        """Unit vectors of the rays of scan `index`, in the sensor frame or, given rotations, in the world frame."""
        azimuths = self.azimuths(index)
        elevations = np.radians(self.elevations_deg)[:, None, None]
        R = np.eye(3)[None] if R_world_column is None else R_world_column
        level = np.cos(azimuths)[:, None] * R[..., 0] + np.sin(azimuths)[:, None] * R[..., 1]
        cos, sin = np.cos(elevations).astype(np.float32), np.sin(elevations).astype(np.float32)
        return cos * level.astype(np.float32) + sin * R[..., 2].astype(np.float32)

    def measure(
        self,
        distances: Float[np.ndarray, "beams columns"],
        cos_incidence: Float[np.ndarray, "beams columns"],
        rng: np.random.Generator,
    ) -> UInt16[np.ndarray, "beams columns"]:
        """The reported range image: true distances with noise, drop-out and limits of the range.

        Args:
            distances: distance to the first surface on each ray [m]; infinite if there is none.
            cos_incidence: cosine of the angle between the ray and the normal of the surface.
            rng: random generator of the noise and the drop-out.

        Returns:
            Ranges in steps of `RANGE_STEP`, 0 where nothing came back.
        """
        noise = rng.standard_normal(distances.shape, dtype=np.float32)
        chance = rng.random(distances.shape, dtype=np.float32)
        keep = np.isfinite(distances)
        ranges = np.where(keep, distances, 0) + np.float32(self.range_noise) * noise
        keep &= (ranges >= self.min_range) & (ranges <= self.max_range)
        lost, fading = np.float32(self.drop_out), ranges * ranges * np.float32(1 / self.reach**2)
        # chance >= drop_out + (1 - drop_out) / (1 + signal) with signal = cos_incidence / fading, without divisions
        keep &= (chance - lost) * (cos_incidence + fading) >= np.float32(1 - self.drop_out) * fading
        steps = np.where(keep, ranges, 0) * np.float32(1 / RANGE_STEP) + np.float32(0.5)
        return steps.astype(np.uint16)

    def points(
        self, ranges: UInt16[np.ndarray, "beams columns"], index: int
    ) -> tuple[Float[np.ndarray, "n 3"], Float[np.ndarray, "n"]]:
        """Points in float32 [m] and their times in periods, see `column_times`, ordered by beam as in KITTI's files.

        Each point is in the frame of the sensor at the time of its firing.
        """
        hit = ranges > 0
        points = self.directions(index)[hit] * (ranges[hit] * np.float32(RANGE_STEP))[:, None]
        times = np.broadcast_to(self.column_times().astype(np.float32), ranges.shape)[hit]
        return points, times


def hdl64(columns: int = 2000) -> Sensor:
    """Velodyne HDL-64E: 32 beams 1/3 deg apart above 32 beams 1/2 deg apart.

    Source: HDL-64E manual (+2 to -24.33 deg); KITTI's scans show the same two blocks.
    """
    elevations = (*np.linspace(2, -8.33, 32).tolist(), *np.linspace(-8.83, -24.33, 32).tolist())
    return Sensor("HDL-64E", elevations, columns)


def hdl32(columns: int = 2000) -> Sensor:
    """Velodyne HDL-32E upright: 32 beams from +10.67 to -30.67 deg."""
    return Sensor("HDL-32E", tuple(np.linspace(10.67, -30.67, 32).tolist()), columns, max_range=100.0)


def hdl32_inverted(columns: int = 2000) -> Sensor:
    """Velodyne HDL-32E mounted upside down, as on NCLT's Segway: +30.67 to -10.67 deg."""
    return Sensor("HDL-32E inverted", tuple(np.linspace(30.67, -10.67, 32).tolist()), columns, max_range=100.0)


def vlp16(columns: int = 1800) -> Sensor:
    """Velodyne VLP-16: 16 beams from +15 to -15 deg."""
    return Sensor("VLP-16", tuple(np.linspace(15, -15, 16).tolist()), columns, range_noise=0.03, max_range=100.0)


def os1_64(columns: int = 1024) -> Sensor:
    """Ouster OS1-64 of the second generation: 64 beams from +21.2 to -21.2 deg."""
    return Sensor("OS1-64", tuple(np.linspace(21.2, -21.2, 64).tolist()), columns, range_noise=0.03)
