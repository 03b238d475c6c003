"""Nearest neighbours by looking into the voxels around a point."""

import torch
from jaxtyping import Float, Int
from torch import Tensor

from lidarlearn.geometry import se3
from lidarlearn.registration.association.aggregated_points import AggregatedPoints
from lidarlearn.registration.association.base import Association, Correspondences, no_correspondences

_CANDIDATES_AT_ONCE = 1 << 19  # bounds the memory of a wide search
_MAX_REACH = 4  # voxel edges; beyond, a search would visit more than 9^3 voxels per point


class VoxelHash(Association):
    """The nearest point among the voxels around the query: exact within the search distance, up to four voxel edges.

    Nothing is built per scan: the table of the aggregated map is the search structure. It runs on tensors alone, on
    the CPU and on CUDA.

    Args:
        voxel_size_m: edge of the voxels, which hold one point each [m].
        device: where the map is kept and searched.

    Source: the option that Dellenbach et al. 2021, III-A "Local map and neighborhood", names as the way to be faster.
    """

    def __init__(self, voxel_size_m: float = 0.4, device: torch.device | str = "cpu") -> None:
        self._device = torch.device(device)
        self._voxel_size_m = voxel_size_m
        self.clear()

    def clear(self) -> None:
        """Forget every scan."""
        self._map = AggregatedPoints(self._voxel_size_m, self._device)

    @property
    def is_empty(self) -> bool:
        """Whether there is nothing to search in."""
        return len(self._map.points) == 0

    def insert(self, points: Float[Tensor, "n 3"], T_world_lidar: Float[Tensor, "4 4"], frames: int) -> None:
        """Add a registered scan."""
        self._map.insert(se3.transform(T_world_lidar, points), frames)

    def search(self, points_world: Float[Tensor, "n 3"], max_distance_m: float) -> Correspondences:
        """The nearest point of the voxels that the search distance reaches, up to four edges away."""
        if self.is_empty:
            return no_correspondences(points_world)
        reach_m = min(max_distance_m, _MAX_REACH * self._voxel_size_m)
        chunks = points_world.split(max(_CANDIDATES_AT_ONCE // self._map.cells_across(reach_m) ** 3, 1))
        found = [self._nearest(chunk, reach_m) for chunk in chunks]
        index = torch.cat([i for i, _ in found])
        squared = torch.cat([s for _, s in found])
        return Correspondences(self._map.points[index], self._map.normals[index], squared <= max_distance_m**2)

    def _nearest(self, points: Float[Tensor, "n 3"], reach_m: float) -> tuple[Int[Tensor, "n"], Float[Tensor, "n"]]:
        """Index of the nearest candidate of each point, and its squared distance."""
        candidates = self._map.around(points, reach_m)
        squared = torch.zeros_like(candidates, dtype=points.dtype)
        for coordinate, queried in zip(self._map.coordinates, points.unbind(-1), strict=True):
            offset = coordinate.index_select(0, candidates.flatten()).view_as(candidates) - queried[:, None]
            squared.addcmul_(offset, offset)
        best = squared.min(dim=1)
        return candidates.gather(1, best.indices[:, None])[:, 0].long(), best.values
