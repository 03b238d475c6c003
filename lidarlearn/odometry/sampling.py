"""Which points of a scan go into the map, and which of those are registered."""

import functools
import math
from abc import ABC, abstractmethod
from dataclasses import dataclass, field

import torch
from jaxtyping import Float, Int
from torch import Tensor

from lidarlearn.cuda_graphs import GraphCache, Padding
from lidarlearn.errors import require_positive
from lidarlearn.geometry import se3
from lidarlearn.geometry.projection import SphericalProjection
from lidarlearn.geometry.voxels import grid_sample
from lidarlearn.odometry.deskew import deskew

_NEIGHBOURHOOD_M = 0.4
_PADDING = Padding()


@dataclass(frozen=True)
class SampledScan:
    """The sampled points of a scan, as measured.

    Args:
        points: points for the map [m].
        times: time of each, as a share of the scan period, see `lidarlearn.data.sequence.Scan`; None if unknown.
        queries: indices, ascending, of the points that are also registered.
    """

    points: Float[Tensor, "n 3"]
    times: Float[Tensor, "n"] | None
    queries: Int[Tensor, "m"]

    @functools.cached_property
    def mean_range_m(self) -> float:
        """Mean distance of the points from the sensor [m]."""
        return self.points.norm(dim=1).mean().item()

    @functools.cached_property
    def phases(self) -> Float[Tensor, "n"]:
        """When each point was measured, as a share of the scan period; derived from the azimuth if times are unknown.

        LiDARs turn clockwise as seen from above. Where a turn begins is unknown; the pose is taken to be that of its
        middle, at azimuth 0.
        """
        if self.times is not None:
            return self.times
        return torch.atan2(self.points[:, 1], self.points[:, 0]) / (-2 * math.pi)

    def deskewed(
        self, motion_per_period: Float[Tensor, "4 4"], skew: Float[Tensor, "6"] | None = None
    ) -> Float[Tensor, "n 3"]:
        """All points, compensated for the motion over one scan period and for the skew that remained.

        Args:
            motion_per_period: the motion; ignored for scans without times, which are compensated already.
            skew: see `RegistrationResult.skew`.
        """
        if skew is None or not skew.any():
            return deskew(self.points, self.times, motion_per_period)
        known = torch.zeros_like(skew) if self.times is None else se3.log(motion_per_period)
        return deskew(self.points, self.phases, se3.exp(known + skew))


class Sampling(ABC):
    """Selects points of a scan."""

    @property
    def neighbourhood_m(self) -> float:
        """Edge of the voxels for normals: these are estimated from a voxel and those around it [m]."""
        return _NEIGHBOURHOOD_M

    @abstractmethod
    def sample(self, points: Float[Tensor, "n 3"], times: Float[Tensor, "n"] | None = None) -> SampledScan:
        """The points to use.

        Args:
            points: the scan [m].
            times: time of each point, as a share of the scan period; None: there is nothing to compensate.
        """


@dataclass(frozen=True)
class GridSampling(Sampling):
    """One point per voxel for the map; all of them, or one per wider voxel, are registered.

    Args:
        map_voxel_m: voxel edge for the map [m].
        query_voxel_m: voxel edge for the points to register [m], no finer than the map's; None registers all.

    Source: Dellenbach et al. 2021, IV-A: 0.4 m.
    """

    map_voxel_m: float = 0.4
    query_voxel_m: float | None = None
    _graphs: GraphCache = field(default_factory=GraphCache, init=False, repr=False, compare=False)

    def __post_init__(self) -> None:
        require_positive("sampling", map_voxel_m=self.map_voxel_m)

    @property
    def neighbourhood_m(self) -> float:
        """At least the edge of the map's voxels [m]."""
        return max(super().neighbourhood_m, self.map_voxel_m)

    def sample(self, points: Tensor, times: Tensor | None = None) -> SampledScan:
        """One point of every voxel, drawn by `grid_sample`, in the order of the voxels."""
        index = grid_sample(points, self.map_voxel_m, self._graphs)
        points = points[index]
        if self.query_voxel_m is not None and self.query_voxel_m > self.map_voxel_m:
            queries = grid_sample(points, self.query_voxel_m, self._graphs).sort().values
        else:
            queries = torch.arange(len(points), device=points.device)
        return SampledScan(points, None if times is None else times[index], queries)


@dataclass(frozen=True)
class ImageSampling(Sampling):
    """The nearest point of every pixel for the map; some of these, evenly spread, are registered.

    Args:
        projection: the image.
        max_queries: largest number of points to register.

    Source: Dellenbach et al. 2021, IV-A: "this resolution acts as a spherical sampler".
    """

    projection: SphericalProjection
    max_queries: int = 8000
    _graphs: GraphCache = field(default_factory=GraphCache, init=False, repr=False, compare=False)

    def __post_init__(self) -> None:
        require_positive("sampling", max_queries=self.max_queries)

    def sample(self, points: Tensor, times: Tensor | None = None) -> SampledScan:
        """The nearest points, and an evenly strided subset of them, scattered over rows and columns."""
        nearest_points = self.projection.nearest_points
        index = self._graphs(nearest_points, points, device=points.device, padding=_PADDING).flatten()
        index = index[index >= 0]
        count = min(self.max_queries, len(index))
        chosen = torch.linspace(0, max(len(index) - 1, 0), count, dtype=torch.float64, device=points.device)
        return SampledScan(points[index], None if times is None else times[index], chosen.round_().long())
