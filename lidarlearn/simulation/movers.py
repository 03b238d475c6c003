"""Cars and people that move."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from jaxtyping import Float

from lidarlearn.simulation.meshes import Mesh
from lidarlearn.simulation.trajectories import arc_length


@dataclass(frozen=True)
class Mover:
    """Something that moves along a line.

    Args:
        mesh: its shape, standing at the origin and facing x.
        lane: points of the line, on the ground [m].
        times: times at which `travelled` is given [s].
        travelled: arc length along the lane at these times [m]; beyond either end of the lane it is absent.
    """

    mesh: Mesh
    lane: Float[np.ndarray, "n 3"]
    times: Float[np.ndarray, "k"]
    travelled: Float[np.ndarray, "k"]

    @cached_property
    def _arc_length(self) -> Float[np.ndarray, "n"]:
        return arc_length(self.lane)

    def position(self, time: float, ahead: float = 0.0) -> Float[np.ndarray, "3"] | None:
        """Its position at a time [s], or the point `ahead` of it on the lane [m]; None while it is absent."""
        end = self._arc_length[-1]
        here = np.interp(time, self.times, self.travelled)
        if not 0 <= here <= end:
            return None
        place = np.clip(here, 1.0, end - 1.0) + ahead
        return np.array([np.interp(place, self._arc_length, self.lane[:, k]) for k in range(3)])

    def at(self, time: float) -> Mesh | None:
        """Its mesh at its position at a time [s]; None while it is absent."""
        centre, back, front = (self.position(time, ahead) for ahead in (0.0, -1.0, 1.0))
        if centre is None or back is None or front is None:
            return None
        x, y, z = centre
        return self.mesh.moved(x, y, z, yaw=np.arctan2(front[1] - back[1], front[0] - back[0]))


def snapshot(movers: Sequence[Mover], time: float, centre: Float[np.ndarray, "3"], radius: float) -> list[Mesh]:
    """The meshes of all movers within `radius` [m] of a point at a time [s]."""
    near = (m for m in movers if (at := m.position(time)) is not None and np.linalg.norm(at - centre) < radius)
    return [mesh for mover in near if (mesh := mover.at(time)) is not None]
