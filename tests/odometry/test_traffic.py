"""Vehicles beside the sensor do not pull its pose along."""

import numpy as np
import pytest

from lidarlearn.simulation import objects
from lidarlearn.simulation.drive import Drive
from lidarlearn.simulation.movers import Mover
from lidarlearn.simulation.worlds import World
from tests import scenes
from tests.odometry.odometries import ASSOCIATIONS, FRAMES, SMALL, build, motion_errors, poses, run, scans_of, slow


def past_lorries(step_m: float, lorry_step_m: float) -> Drive:
    """A drive past three lorries that come towards the sensor on the next lane, `lorry_step_m` a scan."""
    times, towards = 0.1 * np.arange(FRAMES), np.arange(150.0, -150.0, -1.0)
    lane = np.column_stack([towards, np.full_like(towards, 3.2), np.zeros_like(towards)])
    travelled = 130.0 + lorry_step_m * np.arange(FRAMES)  # the first one is 20 m ahead at the start
    lorries = [Mover(objects.lorry(np.random.default_rng(i)), lane, times, travelled - 9.0 * i) for i in range(3)]
    path = scenes.straight_path(FRAMES, step_m)
    return Drive(World(scenes.street().static, tuple(lorries)), poses=path, frames=FRAMES, sensor=SMALL)


@pytest.mark.parametrize("association", ASSOCIATIONS)
@pytest.mark.parametrize("map_", ["f2m", pytest.param("f2f", marks=slow)])
def test_slow_lorries_do_not_pull_the_pose(association, map_):
    """They move too little from scan to scan for the search distance to exclude them."""
    drive = past_lorries(0.6, lorry_step_m=0.3)
    frames = run(build(f"cv+{association}_{map_}"), scans_of(drive))
    translations, _ = motion_errors(poses(frames), drive.T_world_lidar)
    assert translations.max() < 0.015
