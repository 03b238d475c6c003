"""The memory of an odometry is bounded by its window, however long the drive."""

import resource
from collections.abc import Iterator
from functools import cache

import numpy as np
import pytest
import torch
from torch import Tensor

from lidarlearn.geometry import se3
from lidarlearn.odometry.base import BaseOdometry, Frame
from lidarlearn.simulation.drive import Drive
from lidarlearn.simulation.sensors import Sensor
from tests import scenes
from tests.odometry.odometries import build, kd_fast_others_slow, scans_of

TINY = Sensor("tiny", tuple(np.linspace(20, -25, 32).tolist()), 96)
TINY_IMAGE = [
    f"data.projection.{name}={value}"
    for name, value in {"height": 32, "width": 90, "fov_up_deg": 20.7, "fov_down_deg": -25.7}.items()
]


@cache
def loop() -> Drive:
    """Forth and back through a room, without a jerk."""
    path = scenes.straight_path(60, 0.0)
    path[:, 0, 3] = -3 * np.cos(2 * np.pi * np.arange(60) / 60)
    return Drive(scenes.room(), poses=path, frames=60, sensor=TINY)


def looping(odometry: BaseOdometry, count: int) -> Iterator[Frame]:
    """The frames of an endless drive, each checked."""
    tiny, true = scans_of(loop()), loop().T_world_lidar
    previous = se3.identity()
    for i in range(count):
        frame = odometry.register_scan(tiny[i % 60])
        motion, true_motion = se3.inverse(previous) @ frame.T_world_lidar, se3.inverse(true[i % 60 - 1]) @ true[i % 60]
        assert not frame.health.flagged and (i == 0 or (motion - true_motion)[:3, 3].norm() < 0.05)
        previous = frame.T_world_lidar
        yield frame


def held_bytes(thing: object, seen: set[int]) -> int:
    """Bytes of all tensors that an object holds, each storage once."""
    if id(thing) in seen:
        return 0
    seen.add(id(thing))
    if isinstance(thing, Tensor):
        storage = thing.untyped_storage()
        known = storage.data_ptr() in seen
        seen.add(storage.data_ptr())
        return 0 if known else storage.nbytes()
    if isinstance(thing, dict):
        return sum(held_bytes(value, seen) for value in thing.values())
    if isinstance(thing, list | tuple | set) or type(thing).__name__ == "deque":
        return sum(held_bytes(value, seen) for value in thing)
    return held_bytes(vars(thing), seen) if hasattr(thing, "__dict__") else 0


@kd_fast_others_slow
def test_memory_stops_growing_when_window_is_full(association):
    odometry = build(f"cv+{association}_f2m", f"odometry.{association}_f2m.local_map.size=3", *TINY_IMAGE)
    held = [held_bytes(odometry, set()) for _ in looping(odometry, 16)]
    one_scan = 12 * TINY.beams * TINY.columns
    assert max(held[8:]) - max(held[:8]) < 2 * one_scan


@pytest.mark.slow
@pytest.mark.parametrize("association", ["kd", "p"])
def test_process_memory_is_flat_over_3000_frames(association):
    """The voxel hash keeps the same map as the KdTree."""
    odometry = build(f"cv+{association}_f2m", *TINY_IMAGE)
    after_1000 = 0
    for frame in looping(odometry, 3_000):
        if frame.health.frame == 1000:
            after_1000 = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    growth_mib = (resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - after_1000) / 1024
    assert growth_mib < 40
    R = frame.T_world_lidar[:3, :3]
    torch.testing.assert_close(R @ R.T, torch.eye(3, dtype=torch.float64), rtol=0, atol=1e-12)
