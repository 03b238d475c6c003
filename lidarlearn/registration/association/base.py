"""What an association is: a map that grows by scans, forgets the oldest, and finds the neighbours of points."""

from abc import ABC, abstractmethod
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from lidarlearn import cuda_graphs
from lidarlearn.cuda_graphs import Recordings


@dataclass(frozen=True)
class Neighbours:
    """The nearest map point of each query, and what must have happened before it can be another.

    Args:
        queries: where each query was when its neighbour was looked up [m].
        bins: which part of the map was looked at, see `Association.bins`.
        index: the nearest point of that part, -1 where there is none.
        others_m: all its other points were at least this far from the query [m].
    """

    queries: Float[Tensor, "n 3"]
    bins: Int[Tensor, "n"]
    index: Int[Tensor, "n"]
    others_m: Float[Tensor, "n"]

    def replaced(self, which: Int[Tensor, "m"], by: "Neighbours") -> "Neighbours":
        """A copy with some of them exchanged."""
        return Neighbours(
            self.queries.index_copy(0, which, by.queries),
            self.bins.index_copy(0, which, by.bins),
            self.index.index_copy(0, which, by.index),
            self.others_m.index_copy(0, which, by.others_m),
        )


@dataclass(frozen=True)
class Correspondences:
    """The map point that each query point is associated with.

    Args:
        points: map points [m] in the map's frame; meaningless where `mask` is false.
        normals: unit normals of the map there; zero where undefined.
        mask: whether there is a neighbour within the search distance.
        neighbours: what a search of the same points, moved a little, may start from.
    """

    points: Float[Tensor, "n 3"]
    normals: Float[Tensor, "n 3"]
    mask: Bool[Tensor, "n"]
    neighbours: Neighbours | None = None


class Association(ABC):
    """A map of the last `frames` inserted scans, searchable for the neighbours of points.

    The map's frame is fixed ("world"). Points are float32: they resolve 1 mm at 10 km from the origin.
    """

    @abstractmethod
    def insert(self, points: Float[Tensor, "n 3"], T_world_lidar: Float[Tensor, "4 4"], frames: int) -> None:
        """Add a registered scan and forget all but the last `frames` scans.

        Args:
            points: the scan [m], in the sensor's frame.
            T_world_lidar: where it was registered.
            frames: how many scans the map holds, this one included.
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
        """Some of `points`, by their index."""
        return self.points[index]

    def normals_at(self, index: Int[Tensor, "n"]) -> Float[Tensor, "n 3"]:
        """Some of `normals`, by their index."""
        return self.normals[index]

    @property
    def recordings(self) -> Recordings | None:
        """Of functions that search in this map, where all of that is done on its device; else None."""
        return None

    def reach_m(self, max_distance_m: float) -> float:
        """A distance of a few, at least as long [m], in which as good as no more has to be looked at.

        Recordings are of one search distance: fewer of them are needed.
        """
        return max_distance_m

    @property
    def is_empty(self) -> bool:
        """Whether there is nothing to search in."""
        return len(self.points) == 0

    def search(
        self, points_world: Float[Tensor, "n 3"], max_distance_m: float, last: Neighbours | None = None
    ) -> Correspondences:
        """The neighbour of each point among the map's points, no farther than `max_distance_m`.

        Args:
            points_world: points [m], in the map's frame.
            max_distance_m: farther points of the map are no neighbours [m].
            last: what was found for the same points where they stood before, in the same map. It changes nothing but
                the work: a point that moved by less than half the lead of its neighbour over all others keeps it.
                Left aside if it is of another number of points, and where looking up all is faster than asking which.
        """
        if self.is_empty:
            nothing = torch.zeros_like(points_world)
            return Correspondences(nothing, nothing, torch.zeros_like(points_world[:, 0], dtype=torch.bool))
        bins = self.bins(points_world)
        is_recorded = self.recordings is not None and cuda_graphs.are_used_on(points_world.device)
        if last is None or len(last.index) != len(points_world) or is_recorded:
            neighbours = self.nearest(points_world, bins, max_distance_m)
        else:
            neighbours = self._followed(points_world, bins, max_distance_m, last)
        index = neighbours.index.clamp(min=0)
        points = self.points_at(index)
        within = (points - points_world).square().sum(dim=1) <= max_distance_m**2
        return Correspondences(points, self.normals_at(index), within & (neighbours.index >= 0), neighbours)

    def bins(self, points_world: Float[Tensor, "n 3"]) -> Int[Tensor, "n"]:
        """In which part of the map each point looks for its neighbour: everywhere, if not defined otherwise."""
        return torch.zeros(len(points_world), dtype=torch.int64, device=points_world.device)

    @abstractmethod
    def nearest(self, points_world: Float[Tensor, "n 3"], bins: Int[Tensor, "n"], max_distance_m: float) -> Neighbours:
        """Look up the nearest point of each point's place; farther ones than `max_distance_m` need not be found."""

    def _followed(self, points_world: Tensor, bins: Tensor, max_distance_m: float, last: Neighbours) -> Neighbours:
        """Look up only what may have changed."""
        moved = (points_world - last.queries).norm(dim=1)
        distances = (self.points_at(last.index.clamp(min=0)) - points_world).norm(dim=1)
        distances = torch.where(last.index < 0, max_distance_m, distances.clamp(max=max_distance_m))
        stale = (distances > last.others_m - moved) | (bins != last.bins)
        which = stale.nonzero()[:, 0]
        return last.replaced(which, self.nearest(points_world[which], bins[which], max_distance_m))
