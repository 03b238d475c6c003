"""Nearest neighbours by looking into the voxels around a point."""

import math

import torch
from jaxtyping import Float, Int
from torch import Tensor

from lidarlearn.registration.association.aggregated_map import AggregatedMap
from lidarlearn.registration.association.base import Neighbours
from lidarlearn.registration.association.candidates import NearestTwo, nearest_two

_CANDIDATES_AT_ONCE = 1 << 19  # bounds the memory of a wide search
_FEW_CANDIDATES = 1 << 16  # so many are looked at in the time that it takes to ask
_MIN_RADIUS = 2  # voxels; points without a neighbour look so far, and need not look again soon
_MAX_RADIUS = 4  # voxels; beyond, a search would visit more than 9^3 of them per point


class VoxelHash(AggregatedMap):
    """The nearest point among the voxels around the query: exact within the search distance, up to four voxel edges.

    Nothing is built per scan: the table of the aggregated map is the search structure. It runs on tensors alone, on
    the CPU and on CUDA.

    Source: the option that Dellenbach et al. 2021, III-A "Local map and neighborhood", names as the way to be faster.
    """

    def nearest(
        self, points_world: Float[Tensor, "n 3"], places: Int[Tensor, "n"], max_distance_m: float
    ) -> Neighbours:
        """The nearest point in wider and wider cubes of voxels around each point, until none can be nearer."""
        widest = max(_MIN_RADIUS, min(math.ceil(max_distance_m / self._voxel_size_m), _MAX_RADIUS))
        radius = 1
        while radius < widest and len(points_world) * (2 * radius + 3) ** 3 <= _FEW_CANDIDATES:
            radius += 1
        found = self._within(points_world, radius)
        searched_m = torch.full_like(found.first_m, radius * self._voxel_size_m)
        while radius < widest and len(alone := (found.first_m > radius * self._voxel_size_m).nonzero()[:, 0]):
            radius += 1
            found = found.improved(alone, self._within(points_world[alone], radius, inner=radius - 1))
            searched_m[alone] = radius * self._voxel_size_m
        return Neighbours(points_world, places, found.index, torch.minimum(found.second_m, searched_m))

    def _within(self, points: Float[Tensor, "n 3"], radius: int, inner: int = -1) -> NearestTwo:
        """The nearest of a cube of voxels around each point, see `AggregatedPoints.around`."""
        chunks = points.split(max(_CANDIDATES_AT_ONCE // (2 * radius + 1) ** 3, 1))
        found = [nearest_two(self._map.coordinates, self._map.around(c, radius, inner), c) for c in chunks]
        if len(found) == 1:
            return found[0]
        return NearestTwo(
            torch.cat([part.index for part in found]),
            torch.cat([part.first_m for part in found]),
            torch.cat([part.second_m for part in found]),
        )
