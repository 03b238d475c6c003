"""Neighbours that share a pixel of the spherical image."""

import torch
from jaxtyping import Float, Int
from torch import Tensor

from lidarlearn.geometry import se3
from lidarlearn.geometry.normals import normal_map
from lidarlearn.geometry.projection import SphericalProjection, nearest_per_slot
from lidarlearn.geometry.ranges import squared_ranges
from lidarlearn.registration.association.base import Association, Neighbours
from lidarlearn.registration.association.candidates import nearest_two
from lidarlearn.registration.association.sliding_window import SlidingWindow


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
        self._window = SlidingWindow(self._device)
        self._T_lidar_world = se3.identity().to(self._window.normals)

    @property
    def points(self) -> Float[Tensor, "m 3"]:
        """All points of the map [m], oldest first."""
        return self._window.points

    @property
    def normals(self) -> Float[Tensor, "m 3"]:
        """Their unit normals."""
        return self._window.normals

    def insert(self, points: Float[Tensor, "n 3"], T_world_lidar: Float[Tensor, "4 4"], frames: int) -> None:
        """Add a registered scan and project the whole map into its image."""
        vertices = self.projection.vertex_map(points)
        normals = normal_map(vertices)
        used = (normals != 0).any(dim=0).flatten().nonzero()[:, 0]
        R = T_world_lidar[:3, :3].to(normals)
        self._window.forget(frames - 1)
        vertices, normals = (image.flatten(1).index_select(1, used) for image in (vertices, normals))
        self._window.push(_moved(T_world_lidar, vertices), (R @ normals).mT)
        self._T_lidar_world = se3.inverse(T_world_lidar).to(vertices)
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
        nearest = nearest_two(self._window.coordinates, candidates.clamp_(min=0), points_world, ~nothing)
        index = torch.where(nearest.first_m < torch.inf, nearest.index, -1)
        return Neighbours(points_world, places, index, nearest.second_m)

    def _project(self) -> Int[Tensor, "pixels scans"]:
        """Index of the nearest point of each scan in each pixel, -1 where there is none."""
        local = _moved(self._T_lidar_world, self._window.coordinates).mT
        scans, pixels = len(self._window), self.projection.pixels
        # One pixel more, in front, for the points that fall into none.
        slots = self.projection.pixel_index(local).add_(1).mul_(scans).add_(self._window.scans)
        nearest = nearest_per_slot(slots, squared_ranges(local), (pixels + 1) * scans)
        return nearest[scans:].unflatten(0, (pixels, scans))


def _moved(T: Float[Tensor, "4 4"], coordinates: Float[Tensor, "3 n"]) -> Float[Tensor, "3 n"]:
    """Points whose coordinates lie apart in memory, as projections and distances like them, and stay apart."""
    T = T.to(coordinates)
    return torch.addmm(T[:3, 3:], T[:3, :3], coordinates)
