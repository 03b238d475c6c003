"""The part that associations with a voxel map share."""

import torch
from jaxtyping import Float, Int
from torch import Tensor

from lidarlearn.geometry import se3
from lidarlearn.registration.association.base import Association
from lidarlearn.registration.association.voxel_map import VoxelMap


class VoxelMapAssociation(Association):
    """An association whose map is a `VoxelMap`; subclasses add the search.

    Args:
        voxel_size_m: edge of the voxels; each holds one point [m].
        device: where the map is kept.

    Source: Dellenbach et al. 2021, III-A "Local map and neighborhood".
    """

    def __init__(self, voxel_size_m: float = 0.4, device: torch.device | str = "cpu") -> None:
        self._device = torch.device(device)
        self._voxel_size_m = voxel_size_m
        self._map = VoxelMap(voxel_size_m, self._device)
        self.clear()

    def clear(self) -> None:
        """Forget every scan."""
        if len(self._map):  # an unused map is kept, as a new one takes 30 ms
            self._map = VoxelMap(self._voxel_size_m, self._device)

    def insert(self, points: Float[Tensor, "n 3"], T_world_lidar: Float[Tensor, "4 4"], frames: int) -> None:
        """Add a registered scan."""
        self._map.insert(se3.transform(T_world_lidar, points), frames)

    def points_at(self, index: Int[Tensor, "n"]) -> Float[Tensor, "n 3"]:
        """`points[index]`."""
        return self._map.points_at(index)

    def normals_at(self, index: Int[Tensor, "n"]) -> Float[Tensor, "n 3"]:
        """`normals[index]`."""
        return self._map.normals_at(index)

    @property
    def points(self) -> Float[Tensor, "m 3"]:
        """All points of the map [m], oldest first."""
        return self._map.points

    @property
    def normals(self) -> Float[Tensor, "m 3"]:
        """Their unit normals."""
        return self._map.normals
