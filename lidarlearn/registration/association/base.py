"""What an association is: a map that grows by scans, forgets the oldest, and finds the neighbours of points."""

from abc import ABC, abstractmethod
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float
from torch import Tensor


@dataclass(frozen=True)
class Correspondences:
    """The map point that each query point is associated with.

    Args:
        points: map points [m] in the map's frame; meaningless where `mask` is false.
        normals: unit normals of the map there; zero where undefined.
        mask: whether there is a neighbour within the search distance.
    """

    points: Float[Tensor, "n 3"]
    normals: Float[Tensor, "n 3"]
    mask: Bool[Tensor, "n"]


def no_correspondences(points: Float[Tensor, "n 3"]) -> Correspondences:
    """What an empty map answers."""
    zeros = torch.zeros_like(points)
    return Correspondences(zeros, zeros, torch.zeros(len(points), dtype=torch.bool, device=points.device))


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
    def search(self, points_world: Float[Tensor, "n 3"], max_distance_m: float) -> Correspondences:
        """The neighbour of each point among the map's points, no farther than `max_distance_m`."""

    @abstractmethod
    def clear(self) -> None:
        """Forget every scan."""

    @property
    @abstractmethod
    def is_empty(self) -> bool:
        """Whether there is nothing to search in."""
