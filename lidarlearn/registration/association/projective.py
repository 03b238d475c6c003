"""Neighbours that share a pixel of the spherical image."""

from collections import deque

import torch
from jaxtyping import Float
from torch import Tensor

from lidarlearn.geometry import se3
from lidarlearn.geometry.normals import normal_map
from lidarlearn.geometry.projection import SphericalProjection, activated
from lidarlearn.registration.association.base import Association, Correspondences, no_correspondences

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
        candidates = self._layers.index_select(0, pixel.clamp(min=0))
        offsets = self._points.index_select(0, candidates.flatten().clamp(min=0)).view(*candidates.shape, 3)
        offsets -= points_world[:, None]
        squared = offsets.square_() @ offsets.new_ones(3)  # a sum over so few is slow
        squared.masked_fill_((candidates < 0) | (pixel < 0)[:, None], torch.inf)
        best = squared.min(dim=1)
        index = candidates.gather(1, best.indices[:, None])[:, 0].clamp(min=0)
        return Correspondences(self._points[index], self._normals[index], best.values <= max_distance_m**2)

    def _project(self) -> Tensor:
        """Index of the nearest point of each scan in each pixel, (pixels, scans), -1 where there is none."""
        T = self._T_lidar_world.float()
        local = torch.addmm(T[:3, 3:], T[:3, :3], self._points.T)  # coordinates apart, as projections like them
        pixel = self.projection.pixel_index(local.T)
        scans = len(self._frames)
        lengths = torch.tensor([len(points) for points, _ in self._frames], device=self._device)
        layer = torch.arange(scans, device=self._device).repeat_interleave(lengths)
        last = self.projection.pixels * scans  # where points go that fall into no pixel
        slot = torch.where(pixel < 0, last, pixel.mul_(scans).add_(layer))
        x, y, z = local
        squared_ranges = (x * x).addcmul_(y, y).addcmul_(z, z)
        key = squared_ranges.view(torch.int32).long().bitwise_left_shift_(32)
        key |= torch.arange(len(pixel), device=self._device)
        layers = torch.full((last + 1,), _NOTHING, device=self._device)
        layers.scatter_reduce_(0, slot, key, "amin")
        return layers[:-1].to(torch.int32).unflatten(0, (self.projection.pixels, scans))  # the lower half of each key
