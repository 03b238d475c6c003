"""Small geometric worlds, and paths through them.

The sensor moves along x, 1.73 m above the floor z = 0. `Drive(scene, poses=straight_path(...))` makes the scans.
"""

from functools import cache

import numpy as np
from jaxtyping import Float

from lidarlearn.simulation import objects
from lidarlearn.simulation.buildings import building
from lidarlearn.simulation.meshes import Mesh, box, merge, sheet
from lidarlearn.simulation.worlds import World

SENSOR_HEIGHT = 1.73


def straight_path(frames: int, step: float, start: float = 0.0, yaw_step: float = 0.0) -> Float[np.ndarray, "n 4 4"]:
    """Poses along x from (start, 0), `step` metres and `yaw_step` radians apart; the path curves with the yaw."""
    yaw = yaw_step * np.arange(frames)
    cos, sin = np.cos(yaw), np.sin(yaw)
    poses = np.tile(np.eye(4), (frames, 1, 1))
    poses[:, 0, 0], poses[:, 0, 1], poses[:, 1, 0], poses[:, 1, 1] = cos, -sin, sin, cos
    poses[1:, 0, 3], poses[1:, 1, 3] = np.cumsum(step * cos[:-1]), np.cumsum(step * sin[:-1])
    poses[:, 0, 3] += start
    poses[:, 2, 3] = SENSOR_HEIGHT
    return poses


def room(length: float = 20.0, width: float = 14.0, height: float = 4.0) -> World:
    """A closed room around the origin with a few boxes in it, which constrains motion in every direction."""
    furniture = [
        box(2.0, 1.0, 1.2).moved(5.0, 3.0, 0.0, 0.4),
        box(1.0, 3.0, 2.0).moved(-6.0, -4.0, 0.0, -0.3),
        box(0.5, 0.5, height).moved(3.0, -3.5, 0.0, 0.8),
    ]
    return World(merge([box(length, width, height), *furniture]))


def corridor(width: float = 8.0, height: float = 6.0, length: float = 1000.0) -> World:
    """An endless floor and two endless plane walls, which do not constrain motion along x."""
    walls = [box(length, 0.2, height).moved(y=side * (width / 2 + 0.1)) for side in (-1, 1)]
    return World(merge([box(length, 4 * width, 1.0, base=-1.0), *walls]))


def tunnel(radius: float = 5.0, length: float = 1000.0) -> World:
    """An endless round tunnel with a flat floor, which does not constrain motion along x."""
    angle = np.linspace(0, np.pi, 65)
    arch = np.stack([0 * angle, radius * np.cos(angle), radius * np.sin(angle)], axis=-1)
    ends = np.array([[-length / 2, 0, 0], [length / 2, 0, 0]])
    return World(merge([box(length, 2 * radius, 1.0, base=-1.0), sheet(ends[:, None] + arch)]))


@cache
def street(seed: int = 0, length: float = 200.0) -> World:
    """A straight street on a plane, from x = -50 on, with houses, trees, lamps and parked cars."""
    rng = np.random.default_rng(seed)
    parts: list[Mesh] = [box(length + 200, 200.0, 1.0, base=-1.0).moved(x=length / 2 - 50)]
    for side in (-1, 1):
        x = -50.0
        while x < length - 50:
            size = rng.uniform(9, 18)
            front = 0.0 if side > 0 else np.pi
            parts.append(building(rng, size, 9.0, rng.uniform(4, 10)).moved(x + size / 2, side * 14.5, 0.0, front))
            parts.append(objects.tree(rng).moved(x + rng.uniform(0, size), side * 6.5))
            parts.append(objects.lamp(rng).moved(x + rng.uniform(0, size), side * 5.5, 0.0, -side * np.pi / 2))
            parts.append(objects.car(rng).moved(x + rng.uniform(0, size), side * 4.5))
            x += size + rng.uniform(0, 6)
    return World(merge(parts))
