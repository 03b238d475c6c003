"""Neighbours that share a pixel of the spherical image."""

import functools
import math
from collections.abc import Callable
from typing import Any

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from lidarlearn import cuda_graphs
from lidarlearn.cuda_graphs import GraphCache, Padding
from lidarlearn.geometry import se3
from lidarlearn.geometry.normals import normal_map
from lidarlearn.geometry.projection import SphericalProjection, nearest_per_bin
from lidarlearn.geometry.ranges import squared_ranges
from lidarlearn.registration.association.base import Association, Neighbours
from lidarlearn.registration.association.candidates import nearest_two
from lidarlearn.registration.association.point_buffer import PointBuffer

_PADDING, _MAP_PADDING = Padding(), Padding(step=1 << 19)


class Projective(Association):
    """The closest in 3D among the map points that share a query point's pixel of the spherical image.

    Each scan is kept as the points and normals of its vertex map, and projected into one layer of an image: the
    candidates of a query are the layers of its pixel. The image has the pose of the last scan or, with a distance
    between images, that of an earlier scan nearby; until the sensor has moved that far, only new scans are projected.

    Args:
        projection: the image, 64x720 px for the HDL-64.
        device: where the map is kept and searched.
        image_distance_m: a scan starts a new image at this distance from the pose of the last image [m]...
        image_tilt_deg: ...or if it is tilted by this angle against it [deg]. With a distance of 0 every scan starts a
            new image, as in the paper.

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
        self._buffer = PointBuffer(self._device)
        self._T_image_world = se3.identity(device=self._device)
        self._layers = torch.empty(self.projection.pixels, 0, dtype=torch.int32, device=self._device)
        self._next_layer = 0

    @property
    def points(self) -> Float[Tensor, "m 3"]:
        """All points of the map [m], oldest first."""
        return self._buffer.points

    @property
    def normals(self) -> Float[Tensor, "m 3"]:
        """Their unit normals."""
        return self._buffer.normals

    @property
    def graphs(self) -> GraphCache:
        """CUDA graphs of functions that search this map."""
        return self._buffer.graphs

    def points_at(self, index: Int[Tensor, "n"]) -> Float[Tensor, "n 3"]:
        """`points[index]`."""
        return self._buffer.points_at(index)

    def normals_at(self, index: Int[Tensor, "n"]) -> Float[Tensor, "n 3"]:
        """`normals[index]`."""
        return self._buffer.normals_at(index)

    def insert(self, points: Float[Tensor, "n 3"], T_world_lidar: Float[Tensor, "4 4"], frames: int) -> None:
        """Add a registered scan, and project it into the image, or the whole map into a new image."""
        vertices, normals, is_used = self._in_graph(self._surface, points, T_world_lidar, padding=_PADDING)
        used = is_used.nonzero()[:, 0]
        self._buffer.forget(frames - 1)
        moved = self._buffer.append(vertices.index_select(1, used), normals.index_select(1, used).mT)
        if self._starts_image(T_world_lidar, frames):
            self._T_image_world.copy_(se3.inverse(T_world_lidar))
            self._layers.copy_(self._project(frames))
            self._next_layer = len(self._buffer) % frames
        else:
            if moved:
                self._layers -= moved
            new = self._in_graph(self._layer, vertices, is_used)
            self._layers[:, self._next_layer] = torch.where(new < 0, -1, new + (self._buffer.end - len(used)))
            self._next_layer = (self._next_layer + 1) % frames

    def _in_graph(self, function: Callable[..., Any], *inputs: Tensor, padding: Padding | None = None) -> Any:
        return self.graphs(function, *inputs, device=self._device, settings=function.__name__, padding=padding)

    def _surface(
        self, points: Float[Tensor, "n 3"], T_world_lidar: Float[Tensor, "4 4"]
    ) -> tuple[Float[Tensor, "3 pixels"], Float[Tensor, "3 pixels"], Bool[Tensor, "pixels"]]:
        """A scan's vertex map and normal map in the map's frame, and which pixels have a normal."""
        vertices = self.projection.vertex_map(points)
        normals = normal_map(vertices).flatten(1)
        R = T_world_lidar[:3, :3].to(normals)
        return _moved(T_world_lidar, vertices.flatten(1)), R @ normals, (normals != 0).any(dim=0)

    def reach_m(self, max_distance_m: float) -> float:
        """Unlimited: all layers of a pixel are compared anyway."""
        return math.inf

    def bins(self, points_world: Float[Tensor, "n 3"]) -> Int[Tensor, "n"]:
        """The pixel of each point, -1 outside the image."""
        return self.projection.pixel_index(se3.transform(self._T_image_world, points_world))

    def nearest(self, points_world: Float[Tensor, "n 3"], bins: Int[Tensor, "n"], max_distance_m: float) -> Neighbours:
        """The closest map point among the layers of each point's pixel."""
        candidates = self._layers.index_select(0, bins.clamp(min=0))
        nothing = (candidates < self._buffer.origin) | (bins < 0)[:, None]
        candidates.clamp_(min=self._buffer.origin)
        nearest = nearest_two(self._buffer.slot_coordinates, candidates, points_world, ~nothing)
        index = torch.where(nearest.first_m < torch.inf, nearest.index - self._buffer.origin, -1)
        return Neighbours(points_world, bins, index, nearest.second_m)

    def _starts_image(self, T_world_lidar: Float[Tensor, "4 4"], frames: int) -> bool:
        """Whether a scan is too far from the image's pose, or the image has another number of layers."""
        if self._layers.shape[1] != frames:
            self._layers = self._layers.new_empty(self.projection.pixels, frames)
            self.graphs.clear()
            return True
        T_image_lidar = self._T_image_world.cpu() @ T_world_lidar.cpu().double()
        distance_m = T_image_lidar[:3, 3].norm().item()
        tilt_deg = math.degrees(math.acos(min(T_image_lidar[2, 2].item(), 1.0)))
        return distance_m >= self._image_distance_m or tilt_deg >= self._image_tilt_deg or len(self._buffer) == 1

    def _project(self, layers: int) -> Int[Tensor, "pixels layers"]:
        """Slot of the nearest point of each scan in each pixel, one layer per scan; -1 for none."""
        if not cuda_graphs.supported_on(self._device):
            return self._nearest_slots(self._buffer.coordinates, self._buffer.scans, layers)
        count = _MAP_PADDING.length(len(self.points))
        numbers = torch.tensor([len(self.points), self._buffer.oldest_scan])
        project = functools.partial(self._project_in_graph, count, layers)
        return self.graphs(project, numbers, device=self._device, settings=("_project", count, layers))

    def _project_in_graph(self, count: int, layers: int, numbers: Int[Tensor, "2"]) -> Int[Tensor, "pixels layers"]:
        """The same for a fixed number of points, reached by repeating some."""
        points, oldest_scan = numbers
        slots = self._buffer.origin + torch.arange(count, device=self._device) % points
        coordinates, scans = self._buffer.at(slots)
        return self._nearest_slots(coordinates, scans - oldest_scan.int(), layers)

    def _nearest_slots(
        self, coordinates: Float[Tensor, "3 m"], scans: Int[Tensor, "m"], layers: int
    ) -> Int[Tensor, "pixels layers"]:
        local = _moved(self._T_image_world, coordinates).mT
        # An additional first pixel holds the points outside the image.
        bins = self.projection.pixel_index(local).add_(1).mul_(layers).add_(scans)
        nearest = nearest_per_bin(bins, squared_ranges(local), (self.projection.pixels + 1) * layers)
        nearest = nearest[layers:].unflatten(0, (self.projection.pixels, layers))
        return torch.where(nearest < 0, -1, nearest + self._buffer.origin)

    def _layer(self, coordinates: Float[Tensor, "3 m"], is_used: Bool[Tensor, "m"]) -> Int[Tensor, "pixels"]:
        """Number of the nearest used point of a scan in each pixel of the image; -1 for none."""
        local = _moved(self._T_image_world, coordinates).mT
        bins = torch.where(is_used, self.projection.pixel_index(local), -1).add_(1)
        nearest = nearest_per_bin(bins, squared_ranges(local), self.projection.pixels + 1)[1:]
        number = is_used.cumsum(0, dtype=torch.int32) - 1
        return torch.where(nearest < 0, -1, number[nearest.clamp(min=0)])


def _moved(T: Float[Tensor, "4 4"], coordinates: Float[Tensor, "3 n"]) -> Float[Tensor, "3 n"]:
    """Transformed points; each axis is contiguous before and after."""
    T = T.to(coordinates)
    return torch.addmm(T[:3, 3:], T[:3, :3], coordinates)
