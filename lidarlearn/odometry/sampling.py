"""Which points of a scan go into the map, and which of those are registered."""

import math
from abc import ABC, abstractmethod
from dataclasses import dataclass

import torch
from jaxtyping import Float, Int
from torch import Tensor

from lidarlearn.geometry.projection import SphericalProjection
from lidarlearn.geometry.voxels import grid_sample

_DENSE_MAP_VOXEL_M, _DENSE_QUERY_VOXEL_M = 0.4, 1.0
_DENSE_RANGE_M = 35.0  # up to here neighbouring beams are no farther apart than a voxel


def map_voxel_m(projection: SphericalProjection) -> float:
    """Voxel edge for the map of a sensor [m]: the paper's 0.4 m for 64 beams, 0.8 m for 32, 1.2 m for 16.

    With 32 beams on a grid of 0.4 m the swinging pitch of a Segway is not followed.

    Args:
        projection: the sensor's image, one row a beam.

    Source: Dellenbach et al. 2021, IV-A, for the HDL-64.
    """
    beam_spacing = math.radians(projection.fov_up_deg - projection.fov_down_deg) / projection.height
    return max(_DENSE_MAP_VOXEL_M, round(beam_spacing * _DENSE_RANGE_M, 1))


def query_voxel_m(projection: SphericalProjection) -> float:
    """Voxel edge for the points of a sensor that are registered [m]: 1 m for 64 beams, as for the map with fewer.

    Args:
        projection: the sensor's image, one row a beam.
    """
    map_voxel = map_voxel_m(projection)
    return _DENSE_QUERY_VOXEL_M if map_voxel == _DENSE_MAP_VOXEL_M else map_voxel


@dataclass(frozen=True)
class SampledScan:
    """Two selections of a scan's points.

    Args:
        map_index: points that are added to the map.
        query_index: points that are associated with the map.
    """

    map_index: Int[Tensor, "m"]
    query_index: Int[Tensor, "q"]


class Sampling(ABC):
    """Selects points of a scan."""

    @abstractmethod
    def sample(self, points: Float[Tensor, "n 3"]) -> SampledScan:
        """Indices of the selected points."""


@dataclass(frozen=True)
class GridSampling(Sampling):
    """One point per voxel: fine for the map, coarse for the points to register.

    Args:
        map_voxel_m: voxel edge for the map [m].
        query_voxel_m: voxel edge for the points to register [m].

    Source: Dellenbach et al. 2021, IV-A: 0.4 m.
    """

    map_voxel_m: float = 0.4
    query_voxel_m: float = 1.0

    def sample(self, points: Tensor) -> SampledScan:
        """The first point of every voxel, in the order of the scan."""
        map_index = grid_sample(points, self.map_voxel_m)
        return SampledScan(map_index, map_index[grid_sample(points[map_index], self.query_voxel_m)])


@dataclass(frozen=True)
class ImageSampling(Sampling):
    """The nearest point of every pixel; as many of them as asked for, evenly spread, are registered.

    Args:
        projection: the image.
        max_queries: how many points are registered at most.

    Source: Dellenbach et al. 2021, IV-A: "this resolution acts as a spherical sampler".
    """

    projection: SphericalProjection
    max_queries: int = 8000

    def sample(self, points: Tensor) -> SampledScan:
        """The nearest points, and an evenly strided subset of them, scattered over rows and columns."""
        index = self.projection.nearest_points(points).flatten()
        index = index[index >= 0]
        # A stride prime to the image's width scatters the subset instead of picking whole columns.
        count = min(self.max_queries, len(index))
        chosen = torch.linspace(0, max(len(index) - 1, 0), count, dtype=torch.float64, device=points.device)
        return SampledScan(index, index[chosen.round().long()])
