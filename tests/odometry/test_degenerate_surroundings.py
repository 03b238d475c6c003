"""Surroundings that do not show how far the sensor has moved are flagged as degenerate."""

import pytest

from lidarlearn.geometry import se3
from lidarlearn.simulation.drive import Drive
from tests import scenes
from tests.odometry.odometries import SENSORS, build, kd_fast_others_slow, poses, run, scans_of, slow


def in_scene(name: str, sensor: str, frames: int = 4) -> Drive:
    world = {"corridor": scenes.corridor, "tunnel": scenes.tunnel, "street": scenes.street}[name]()
    return Drive(world, poses=scenes.straight_path(frames, 1.2), frames=frames, sensor=SENSORS[sensor])


@kd_fast_others_slow
@pytest.mark.parametrize("sensor", ["hdl64", pytest.param("hdl32", marks=slow)])
@pytest.mark.parametrize("name", ["corridor", pytest.param("tunnel", marks=slow)])
def test_endless_corridor_is_degenerate_along_its_axis(association, name, sensor):
    frames = run(build(f"cv+{association}_f2m", projection=sensor), scans_of(in_scene(name, sensor)))
    for frame in frames[1:]:
        assert frame.health.degenerate and frame.health.flagged
        assert abs(frame.health.weakest_direction[0]) > 0.99
    drift = se3.log(poses(frames))[:, 1:]
    assert drift[:, :2].norm(dim=1).max() < 0.1 and drift[:, 2:].norm(dim=1).rad2deg().max() < 1.0


@kd_fast_others_slow
@pytest.mark.parametrize("sensor", ["hdl64", pytest.param("hdl32", marks=slow)])
def test_street_is_not_degenerate(association, sensor):
    frames = run(build(f"cv+{association}_f2m", projection=sensor), scans_of(in_scene("street", sensor)))
    assert not any(frame.health.flagged for frame in frames)


@slow
@kd_fast_others_slow
@pytest.mark.parametrize("sensor", ["vlp16", "os1_64"])
@pytest.mark.parametrize("name", ["corridor", "tunnel"])
def test_endless_corridor_is_degenerate_with_noisier_sensors(association, name, sensor):
    frames = run(build(f"cv+{association}_f2m", projection=sensor), scans_of(in_scene(name, sensor, frames=6)))
    # The image's normals of near walls are noisy; the more scans, the more of them pose as something ahead: 1.3 % of
    # the points after five scans of the OS1.
    surely = frames[1:3] if association == "p" else frames[1:]
    assert all(frame.health.degenerate for frame in surely)
    assert all(frame.health.min_information < 0.02 for frame in frames[1:])
