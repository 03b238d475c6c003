"""The interface of associations: maps of the last scans that find the nearest map point of each query."""

from abc import ABC, abstractmethod
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from lidarlearn import cuda_graphs
from lidarlearn.cuda_graphs import GraphCache


@dataclass(frozen=True)
class Neighbours:
    """The nearest map point of each query, and how close any other candidate can be.

    Args:
        queries: position of each query when its neighbour was searched [m].
        bins: part of the map that was searched, see `Association.bins`.
        index: the nearest point of that part, -1 where there is none.
        others_m: lower bound on the distance of all other candidates [m].
    """

    queries: Float[Tensor, "n 3"]
    bins: Int[Tensor, "n"]
    index: Int[Tensor, "n"]
    others_m: Float[Tensor, "n"]

    def replaced(self, which: Int[Tensor, "m"], by: "Neighbours") -> "Neighbours":
        """A copy in which some are replaced."""
        return Neighbours(
            self.queries.index_copy(0, which, by.queries),
            self.bins.index_copy(0, which, by.bins),
            self.index.index_copy(0, which, by.index),
            self.others_m.index_copy(0, which, by.others_m),
        )


@dataclass(frozen=True)
class Correspondences:
    """The map point that each query is associated with.

    Args:
        points: map points [m], in the map's frame; meaningless where `mask` is false.
        normals: unit normals of the map points, zero where undefined.
        mask: whether there is a neighbour within the search distance.
        neighbours: the result to pass to the next search for the same points.
    """

    points: Float[Tensor, "n 3"]
    normals: Float[Tensor, "n 3"]
    mask: Bool[Tensor, "n"]
    neighbours: Neighbours | None = None


class Association(ABC):
    """A searchable map of the last inserted scans.

    The map's frame is fixed ("world"). Points are float32, which resolves 1 mm at 10 km from the origin.
    """

    @abstractmethod
    def insert(self, points: Float[Tensor, "n 3"], T_world_lidar: Float[Tensor, "4 4"], frames: int) -> None:
        """Add a registered scan and forget all but the last `frames` scans.

        Args:
            points: the scan [m], in the sensor's frame.
            T_world_lidar: its registered pose.
            frames: number of scans that the map keeps, this one included.
        """

    @abstractmethod
    def clear(self) -> None:
        """Forget every scan."""

    @property
    @abstractmethod
    def points(self) -> Float[Tensor, "m 3"]:
        """All points of the map [m]."""

    @property
    @abstractmethod
    def normals(self) -> Float[Tensor, "m 3"]:
        """Their unit normals, zero where undefined."""

    def points_at(self, index: Int[Tensor, "n"]) -> Float[Tensor, "n 3"]:
        """`points[index]`."""
        return self.points[index]

    def normals_at(self, index: Int[Tensor, "n"]) -> Float[Tensor, "n 3"]:
        """`normals[index]`."""
        return self.normals[index]

    @property
    def graphs(self) -> GraphCache | None:
        """CUDA graphs of functions that search this map; None if a search needs the CPU."""
        return None

    def reach_m(self, max_distance_m: float) -> float:
        """The search distance [m], rounded up to one of a few values where that costs little.

        A CUDA graph has a fixed search distance, so few values need few graphs.
        """
        return max_distance_m

    @property
    def is_empty(self) -> bool:
        """Whether the map has no points."""
        return len(self.points) == 0

    def search(
        self, points_world: Float[Tensor, "n 3"], max_distance_m: float, last: Neighbours | None = None
    ) -> Correspondences:
        """The nearest map point of each point, within `max_distance_m`.

        Args:
            points_world: points [m], in the map's frame.
            max_distance_m: search distance [m].
            last: the previous result for the same points in the same map. A point that moved less than half the gap to
                its second-nearest candidate keeps its neighbour, which saves work and does not change results. Ignored
                if its number of points differs, or where searching for all points again is faster.
        """
        if self.is_empty:
            nothing = torch.zeros_like(points_world)
            return Correspondences(nothing, nothing, torch.zeros_like(points_world[:, 0], dtype=torch.bool))
        bins = self.bins(points_world)
        is_captured = self.graphs is not None and cuda_graphs.supported_on(points_world.device)
        if last is None or len(last.index) != len(points_world) or is_captured:
            neighbours = self.nearest(points_world, bins, max_distance_m)
        else:
            neighbours = self._followed(points_world, bins, max_distance_m, last)
        index = neighbours.index.clamp(min=0)
        points = self.points_at(index)
        within = (points - points_world).square().sum(dim=1) <= max_distance_m**2
        return Correspondences(points, self.normals_at(index), within & (neighbours.index >= 0), neighbours)

    def bins(self, points_world: Float[Tensor, "n 3"]) -> Int[Tensor, "n"]:
        """The part of the map that each point searches; the whole map unless overridden."""
        return torch.zeros(len(points_world), dtype=torch.int64, device=points_world.device)

    @abstractmethod
    def nearest(self, points_world: Float[Tensor, "n 3"], bins: Int[Tensor, "n"], max_distance_m: float) -> Neighbours:
        """Search the nearest map point in each point's bin; points beyond `max_distance_m` need not be found."""

    def _followed(self, points_world: Tensor, bins: Tensor, max_distance_m: float, last: Neighbours) -> Neighbours:
        """Search only for the points whose neighbour may have changed."""
        moved = (points_world - last.queries).norm(dim=1)
        distances = (self.points_at(last.index.clamp(min=0)) - points_world).norm(dim=1)
        distances = torch.where(last.index < 0, max_distance_m, distances.clamp(max=max_distance_m))
        stale = (distances > last.others_m - moved) | (bins != last.bins)
        which = stale.nonzero()[:, 0]
        return last.replaced(which, self.nearest(points_world[which], bins[which], max_distance_m))
