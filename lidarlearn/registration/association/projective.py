"""Neighbours that share a pixel of the spherical image."""

import math

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
    """The closest in 3D among the map points that share a query point's pixel in an image taken by the sensor.

    Each scan is kept as the points and normals of its vertex map, and projected into one image, a layer of its own: the
    candidates of a query are the layers of one pixel. The image is that of the last scan or, with distances between
    images, of a scan from which the sensor has hardly moved: until it has, only new scans are projected.

    Args:
        projection: the image, 64x720 px for the HDL-64.
        device: where the map is kept and searched.
        image_distance_m: a scan begins a new image at this distance from the place of the last one [m]...
        image_tilt_deg: ...or tilted by this angle against it [deg]. With a distance of 0 every scan begins one, as in
            the paper.

    Source: Dellenbach et al. 2021, III-A "Local map and neighborhood", P-F2M.
    """

    def __init__(
        self,
        projection: SphericalProjection,
        device: torch.device | str = "cpu",
        image_distance_m: float = 0.0,
        image_tilt_deg: float = 1.0,
    ) -> None:
        self.projection = projection
        self._device = torch.device(device)
        self._image_distance_m = image_distance_m
        self._image_tilt_deg = image_tilt_deg
        self.clear()

    def clear(self) -> None:
        """Forget every scan."""
        self._window = SlidingWindow(self._device)
        self._T_image_world = se3.identity()
        self._layers = torch.empty(self.projection.pixels, 0, dtype=torch.int32, device=self._device)
        self._oldest_layer = 0

    @property
    def points(self) -> Float[Tensor, "m 3"]:
        """All points of the map [m], oldest first."""
        return self._window.points

    @property
    def normals(self) -> Float[Tensor, "m 3"]:
        """Their unit normals."""
        return self._window.normals

    def insert(self, points: Float[Tensor, "n 3"], T_world_lidar: Float[Tensor, "4 4"], frames: int) -> None:
        """Add a registered scan, and project it or, into a new image, the whole map."""
        vertices = self.projection.vertex_map(points)
        normals = normal_map(vertices)
        used = (normals != 0).any(dim=0).flatten().nonzero()[:, 0]
        vertices, normals = (image.flatten(1).index_select(1, used) for image in (vertices, normals))
        R = T_world_lidar[:3, :3].to(normals)
        forgotten = self._window.forget(frames - 1)
        self._window.push(_moved(T_world_lidar, vertices), (R @ normals).mT)
        if self._begins_image(T_world_lidar):
            self._T_image_world = se3.inverse(T_world_lidar)
            self._layers, self._oldest_layer = self._project(len(self._window)), 0
        else:
            self._layers -= forgotten  # negative indices are no points, and the oldest layer holds nothing else now
            new = self._project(1)[:, 0]
            self._layers[:, self._oldest_layer] = torch.where(new < 0, -1, new + (len(self.points) - len(used)))
            self._oldest_layer = (self._oldest_layer + 1) % self._layers.shape[1]

    def places(self, points_world: Float[Tensor, "n 3"]) -> Int[Tensor, "n"]:
        """The pixel of each point, -1 outside the image."""
        return self.projection.pixel_index(se3.transform(self._T_image_world, points_world))

    def nearest(
        self, points_world: Float[Tensor, "n 3"], places: Int[Tensor, "n"], max_distance_m: float
    ) -> Neighbours:
        """The closest map point of each pixel."""
        candidates = self._layers.index_select(0, places.clamp(min=0))
        nothing = (candidates < 0) | (places < 0)[:, None]
        nearest = nearest_two(self._window.coordinates, candidates.clamp_(min=0), points_world, ~nothing)
        index = torch.where(nearest.first_m < torch.inf, nearest.index, -1)
        return Neighbours(points_world, places, index, nearest.second_m)

    def _begins_image(self, T_world_lidar: Float[Tensor, "4 4"]) -> bool:
        """Whether a scan sees the map from elsewhere than the image does, or needs a layer that there is not yet."""
        is_growing = self._layers.shape[1] < len(self._window)
        T_image_lidar = self._T_image_world @ T_world_lidar.to(self._T_image_world)
        distance_m = T_image_lidar[:3, 3].norm().item()
        tilt_deg = math.degrees(math.acos(min(T_image_lidar[2, 2].item(), 1.0)))
        has_moved = distance_m >= self._image_distance_m or tilt_deg >= self._image_tilt_deg
        return is_growing or has_moved or len(self._window) == 1

    def _project(self, scans: int) -> Int[Tensor, "pixels scans"]:
        """Which of the last scans' points, as a layer for each scan, is the nearest in each pixel; -1 for none."""
        coordinates, layers = self._window.last(scans)
        local = _moved(self._T_image_world, coordinates).mT
        # One pixel more, in front, for the points that fall into none.
        slots = self.projection.pixel_index(local).add_(1).mul_(scans).add_(layers)
        nearest = nearest_per_slot(slots, squared_ranges(local), (self.projection.pixels + 1) * scans)
        return nearest[scans:].unflatten(0, (self.projection.pixels, scans)).contiguous()


def _moved(T: Float[Tensor, "4 4"], coordinates: Float[Tensor, "3 n"]) -> Float[Tensor, "3 n"]:
    """Points whose coordinates lie apart in memory, as projections and distances like them, and stay apart."""
    T = T.to(coordinates)
    return torch.addmm(T[:3, 3:], T[:3, :3], coordinates)
