"""Neighbours that share a pixel of the spherical image."""

from collections import deque

import torch
from jaxtyping import Float
from torch import Tensor

from lidarlearn.geometry import se3
from lidarlearn.geometry.normals import normal_map
from lidarlearn.geometry.projection import SphericalProjection, activated
from lidarlearn.registration.association.base import Association, Correspondences, no_correspondences

_NOTHING = torch.iinfo(torch.int64).max


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
        self._frames: deque[tuple[Tensor, Tensor]] = deque()  # points and normals in the world, of each scan
        self._T_lidar_world = torch.eye(4, dtype=torch.float64, device=self._device)

    @property
    def is_empty(self) -> bool:
        """Whether there is nothing to search in."""
        return not any(len(points) for points, _ in self._frames)

    def insert(self, points: Float[Tensor, "n 3"], T_world_lidar: Float[Tensor, "4 4"], frames: int) -> None:
        """Add a registered scan and project the whole map into its image."""
        vertices = self.projection.vertex_map(points)
        normals = normal_map(vertices)
        used = (normals != 0).any(dim=0) & activated(vertices)
        R = T_world_lidar[:3, :3].float()
        self._frames.append((se3.transform(T_world_lidar, vertices[:, used].T), normals[:, used].T @ R.T))
        while len(self._frames) > frames:
            self._frames.popleft()
        self._T_lidar_world = se3.inverse(T_world_lidar)
        self._points = torch.cat([points for points, _ in self._frames])
        self._normals = torch.cat([normals for _, normals in self._frames])
        self._layers = self._project()

    def search(self, points_world: Float[Tensor, "n 3"], max_distance_m: float) -> Correspondences:
        """The closest map point of the same pixel within `max_distance_m`."""
        if self.is_empty:
            return no_correspondences(points_world)
        pixel = self.projection.pixel_index(se3.transform(self._T_lidar_world, points_world))
        candidates = self._layers[pixel.clamp(min=0)]
        squared = (self._points[candidates.clamp(min=0)] - points_world[:, None]).square().sum(-1)
        squared = torch.where((candidates >= 0) & (pixel >= 0)[:, None], squared, torch.inf)
        best = squared.min(dim=1)
        index = candidates.gather(1, best.indices[:, None])[:, 0].clamp(min=0)
        return Correspondences(self._points[index], self._normals[index], best.values <= max_distance_m**2)

    def _project(self) -> Tensor:
        """Index of the nearest point of each scan in each pixel, (pixels, scans), -1 where there is none."""
        local = se3.transform(self._T_lidar_world, self._points)
        pixel = self.projection.pixel_index(local)
        scans = len(self._frames)
        lengths = torch.tensor([len(points) for points, _ in self._frames], device=self._device)
        layer = torch.arange(scans, device=self._device).repeat_interleave(lengths)
        slot = torch.where(pixel < 0, self.projection.pixels * scans, pixel * scans + layer)
        key = local.norm(dim=1).view(torch.int32).long() << 32 | torch.arange(len(local), device=self._device)
        layers = torch.full((self.projection.pixels * scans + 1,), _NOTHING, device=self._device)
        layers.scatter_reduce_(0, slot, key, "amin")
        index = torch.where(layers == _NOTHING, -1, layers & 0xFFFFFFFF)[:-1]
        return index.unflatten(0, (self.projection.pixels, scans))
