"""Neighbours that share a pixel of the spherical image."""

from collections import deque

import torch
from jaxtyping import Float, Int
from torch import Tensor

from lidarlearn.geometry import se3
from lidarlearn.geometry.normals import normal_map
from lidarlearn.geometry.projection import SphericalProjection, activated
from lidarlearn.registration.association.base import Association, Neighbours
from lidarlearn.registration.association.candidates import nearest_two

_NOTHING = torch.iinfo(torch.int64).max  # its lower 32 bits are -1


class Projective(Association):
    """The closest in 3D among the map points that share a query point's pixel in the last scan's image.

    Each scan is kept as the points and normals of its vertex map. When a scan is inserted, all scans are projected
    into its image, one layer each: the candidates of a query are the layers of one pixel.

    Args:
        projection: the image, 64x720 px for the HDL-64.
        device: where the map is kept and searched.

    Source: Dellenbach et al. 2021, III-A "Local map and neighborhood", P-F2M.
    """

    def __init__(self, projection: SphericalProjection, device: torch.device | str = "cpu") -> None:
        self.projection = projection
        self._device = torch.device(device)
        self.clear()

    def clear(self) -> None:
        """Forget every scan."""
        self._frames: deque[tuple[Tensor, Tensor]] = deque()  # coordinates and normals in the world, of each scan
        self._coordinates = torch.zeros(3, 0, device=self._device)
        self._normals = torch.zeros(0, 3, device=self._device)
        self._T_lidar_world = se3.identity().to(self._coordinates)

    @property
    def points(self) -> Float[Tensor, "m 3"]:
        """All points of the map [m], oldest first."""
        return self._coordinates.mT

    @property
    def normals(self) -> Float[Tensor, "m 3"]:
        """Their unit normals."""
        return self._normals

    def insert(self, points: Float[Tensor, "n 3"], T_world_lidar: Float[Tensor, "4 4"], frames: int) -> None:
        """Add a registered scan and project the whole map into its image."""
        vertices = self.projection.vertex_map(points)
        normals = normal_map(vertices)
        used = (normals != 0).any(dim=0) & activated(vertices)
        R = T_world_lidar[:3, :3].to(normals)
        self._frames.append((_moved(T_world_lidar, vertices[:, used]), (R @ normals[:, used]).mT))
        while len(self._frames) > frames:
            self._frames.popleft()
        self._T_lidar_world = se3.inverse(T_world_lidar).to(vertices)
        self._coordinates = torch.cat([coordinates for coordinates, _ in self._frames], dim=1)
        self._normals = torch.cat([normals for _, normals in self._frames])
        self._layers = self._project()

    def places(self, points_world: Float[Tensor, "n 3"]) -> Int[Tensor, "n"]:
        """The pixel of each point, -1 outside the image."""
        return self.projection.pixel_index(se3.transform(self._T_lidar_world, points_world))

    def nearest(
        self, points_world: Float[Tensor, "n 3"], places: Int[Tensor, "n"], max_distance_m: float
    ) -> Neighbours:
        """The closest map point of each pixel."""
        candidates = self._layers.index_select(0, places.clamp(min=0))
        nothing = (candidates < 0) | (places < 0)[:, None]
        nearest = nearest_two(self._coordinates, candidates.clamp_(min=0), points_world, ~nothing)
        index = torch.where(nearest.first_m < torch.inf, nearest.index, -1)
        return Neighbours(points_world, places, index, nearest.second_m)

    def _project(self) -> Tensor:
        """Index of the nearest point of each scan in each pixel, (pixels, scans), -1 where there is none."""
        local = _moved(self._T_lidar_world, self._coordinates)
        pixel = self.projection.pixel_index(local.mT)
        scans = len(self._frames)
        layer = torch.cat([pixel.new_full((len(normals),), i) for i, (_, normals) in enumerate(self._frames)])
        last = self.projection.pixels * scans  # where points go that fall into no pixel
        slot = torch.where(pixel < 0, last, pixel.mul_(scans).add_(layer))
        x, y, z = local
        squared_ranges = (x * x).addcmul_(y, y).addcmul_(z, z)
        key = squared_ranges.view(torch.int32).long().bitwise_left_shift_(32)
        key |= torch.arange(len(pixel), device=self._device)
        layers = torch.full((last + 1,), _NOTHING, device=self._device)
        layers.scatter_reduce_(0, slot, key, "amin")
        return layers[:-1].to(torch.int32).unflatten(0, (self.projection.pixels, scans))  # the lower half of each key


def _moved(T: Float[Tensor, "4 4"], coordinates: Float[Tensor, "3 n"]) -> Float[Tensor, "3 n"]:
    """Points whose coordinates lie apart in memory, as projections and distances like them, and stay apart."""
    T = T.to(coordinates)
    return torch.addmm(T[:3, 3:], T[:3, :3], coordinates)
