"""Maps of simulated scenes for each association, and a scan to register against them."""

from dataclasses import dataclass
from functools import cache

import torch
from torch import Tensor

from lidarlearn.geometry import se3
from lidarlearn.geometry.projection import SphericalProjection
from lidarlearn.odometry.sampling import GridSampling, ImageSampling, Sampling
from lidarlearn.registration.association import KdTree, Projective, VoxelHash
from lidarlearn.registration.association.base import Association
from lidarlearn.registration.association.voxel_map import neighbourhood_normals
from lidarlearn.simulation.drive import Drive
from lidarlearn.simulation.sensors import hdl64
from tests import scenes

ASSOCIATIONS = ("kd", "vh", "p")
_MAP_SCANS = 4


@dataclass(frozen=True)
class Scene:
    """A map of the scans before the new one, and the points and true pose of the new one."""

    association: Association
    queries: Tensor
    normals: Tensor
    T_world_lidar: Tensor


@cache
def drive(name: str, frames: int = _MAP_SCANS + 1) -> Drive:
    world, step = {
        "room": (scenes.room, 0.3),
        "street": (scenes.street, 1.2),
        "corridor": (scenes.corridor, 1.2),
        "tunnel": (scenes.tunnel, 1.2),
    }[name]
    return Drive(world(), poses=scenes.straight_path(frames, step), frames=frames, sensor=hdl64(columns=1024))


@cache
def scene(name: str, association: str) -> Scene:
    """Built as in the backends; not to be modified."""
    scans = drive(name)
    sampling, searchable = make(association)
    for i in range(_MAP_SCANS):
        searchable.insert(sampling.sample(scans.scan(i).points).points, scans.T_world_lidar[i], 30)
    sampled = sampling.sample(scans.scan(_MAP_SCANS).points)
    normals = neighbourhood_normals(sampled.points, 0.4)[sampled.queries]
    queries = sampled.points[sampled.queries]
    stride = 4 if association == "p" else 1
    return Scene(searchable, queries[::stride], normals[::stride], scans.T_world_lidar[_MAP_SCANS])


def make(association: str) -> tuple[Sampling, Association]:
    """An empty map and the sampling that goes with it."""
    if association == "p":
        projection = SphericalProjection()
        return ImageSampling(projection), Projective(projection)
    return GridSampling(0.4, 1.0), {"kd": KdTree, "vh": VoxelHash}[association]()


def errors(T_estimate: Tensor, T_true: Tensor) -> tuple[Tensor, Tensor]:
    """Distance [m] and angle [deg]."""
    T_error = se3.inverse(T_true) @ T_estimate
    return T_error[..., :3, 3].norm(dim=-1), se3.rotation_angle(T_error).rad2deg()


def planar_grid() -> Tensor:
    """Twists up to 1.5 m along and across and 5 deg about each axis, and both at once."""
    rows = [[0.0] * 6]
    for axis in (0, 1):
        rows += [[value if i == axis else 0.0 for i in range(6)] for value in (-1.5, -1.0, -0.5, 0.5, 1.0, 1.5)]
    for axis in (3, 4, 5):
        rows += [[value if i == axis else 0.0 for i in range(6)] for value in (-0.0873, -0.0436, 0.0436, 0.0873)]
    rows += [[1.2 * i, 0.9 * j, 0.0, 0.0, 0.0, 0.0873 * k] for i in (-1, 1) for j in (-1, 1) for k in (-1, 1)]
    return torch.tensor(rows, dtype=torch.float64)


def vertical_grid() -> Tensor:
    """Twists along the vertical."""
    grid = torch.zeros(6, 6, dtype=torch.float64)
    grid[:, 2] = torch.tensor([-1.5, -1.0, -0.5, 0.5, 1.0, 1.5])
    return grid
