"""Nearest neighbours by searching the voxels around a point."""

import math

import torch
from jaxtyping import Float, Int
from torch import Tensor

from lidarlearn import cuda_graphs
from lidarlearn.cuda_graphs import GraphCache
from lidarlearn.registration.association.base import Neighbours
from lidarlearn.registration.association.candidates import NearestTwo, joined, nearest_two
from lidarlearn.registration.association.voxel_map import voxels_reached
from lidarlearn.registration.association.voxel_map_association import VoxelMapAssociation

_MAX_CANDIDATES_AT_ONCE = 1 << 19  # bounds the memory of a wide search
_MAX_CANDIDATES_AT_ONCE_ON_GPU = 1 << 22
_CHEAP_CANDIDATES = 1 << 16  # up to this many are compared faster than the points that need a wider search are selected
_MIN_RADIUS = 2  # voxels; wide enough that points without a neighbour need no new search in every iteration
_MAX_RADIUS = 4  # voxels; a search visits 9^3 of them per point


class VoxelHash(VoxelMapAssociation):
    """The nearest point in the voxels around the query: exact within the search distance, up to four voxel edges.

    Nothing is built per scan, as the table of the voxel map is the search structure. Tensor operations search it on CPU
    and GPU.

    Source: named as a faster option in Dellenbach et al. 2021, III-A "Local map and neighborhood".
    """

    @property
    def graphs(self) -> GraphCache:
        """CUDA graphs of functions that search this map."""
        return self._map.graphs

    def reach_m(self, max_distance_m: float) -> float:
        """One of three: 1.5 voxels, 2 voxels, or unlimited."""
        reaches = (voxels * self._voxel_size_m for voxels in (1.5, _MIN_RADIUS))
        return next((reach_m for reach_m in reaches if max_distance_m <= reach_m), math.inf)

    def nearest(self, points_world: Float[Tensor, "n 3"], bins: Int[Tensor, "n"], max_distance_m: float) -> Neighbours:
        """Search ever wider cubes of voxels around each point, until no other point can be nearer."""
        if cuda_graphs.supported_on(points_world.device):
            return self._nearest_at_once(points_world, bins, max_distance_m)
        widest = max(_MIN_RADIUS, min(math.ceil(max_distance_m / self._voxel_size_m), _MAX_RADIUS))
        radius = 1
        while radius < widest and len(points_world) * (2 * radius + 3) ** 3 <= _CHEAP_CANDIDATES:
            radius += 1
        found = self._within(points_world, radius)
        searched_m = torch.full_like(found.first_m, radius * self._voxel_size_m)
        while radius < widest and len(alone := (found.first_m > radius * self._voxel_size_m).nonzero()[:, 0]):
            radius += 1
            found = found.improved(alone, self._within(points_world[alone], radius, inner=radius - 1))
            searched_m[alone] = radius * self._voxel_size_m
        index = found.index - self._map.origin
        return Neighbours(points_world, bins, index, torch.minimum(found.second_m, searched_m))

    def _within(self, points: Float[Tensor, "n 3"], radius: int, inner: int = -1) -> NearestTwo:
        """The nearest two points of a cube of voxels around each point, see `VoxelMap.around`."""
        chunks = points.split(max(_MAX_CANDIDATES_AT_ONCE // (2 * radius + 1) ** 3, 1))
        return joined([nearest_two(self._map.slot_coordinates, self._map.around(c, radius, inner), c) for c in chunks])

    def _nearest_at_once(self, points_world: Tensor, bins: Tensor, max_distance_m: float) -> Neighbours:
        """Search all voxels within the distance, without waiting for intermediate results."""
        reach_m = min(max_distance_m, _MAX_RADIUS * self._voxel_size_m)
        candidates = voxels_reached(reach_m, self._voxel_size_m) ** 3
        chunks = points_world.split(max(_MAX_CANDIDATES_AT_ONCE_ON_GPU // candidates, 1))
        found = joined([nearest_two(self._map.slot_coordinates, self._map.reached(c, reach_m), c) for c in chunks])
        return Neighbours(points_world, bins, found.index - self._map.origin, found.second_m.clamp(max=reach_m))
