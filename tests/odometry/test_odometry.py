"""Whole odometries, as configured, on generated drives: accurate where they can be, honest where they cannot."""

import math
import resource
from collections.abc import Iterator
from dataclasses import replace
from functools import cache

import numpy as np
import pytest
import torch
from torch import Tensor

from lidarlearn.geometry import se3
from lidarlearn.odometry.scan_by_scan import Frame, ScanByScan
from lidarlearn.simulation import scenes
from lidarlearn.simulation.drive import Drive
from lidarlearn.simulation.sensors import Sensor, hdl32, hdl64, os1_64, vlp16
from tests.odometry.odometries import ASSOCIATIONS, build, motion_errors, poses, run, scans_of

SMALL = hdl64(columns=512)
SENSORS = {"hdl64": hdl64(columns=1024), "hdl32": hdl32(), "vlp16": vlp16(), "os1_64": os1_64()}
slow = pytest.mark.slow
kd_at_least = pytest.mark.parametrize("association", ["kd", *(pytest.param(a, marks=slow) for a in ("p", "vh"))])


FRAMES = 13


@cache
def street(frames: int = FRAMES, step: float = 1.2, yaw_step: float = 0.0, sensor: Sensor = SMALL) -> Drive:
    poses = scenes.straight_path(frames, step, yaw_step=yaw_step)
    return Drive(scenes.street(), poses=poses, frames=frames, sensor=sensor)


@cache
def scans() -> tuple[Tensor, ...]:
    return tuple(scans_of(street()))


@pytest.mark.parametrize("association", ASSOCIATIONS)
@pytest.mark.parametrize("map_", ["f2m", pytest.param("f2f", marks=slow)])
@pytest.mark.parametrize("yaw_step", [pytest.param(0.0, marks=slow), 0.03])
def test_drives_are_followed_from_the_first_frame(association, map_, yaw_step):
    """12 m/s and up to 17 deg/s, with no prior for the second scan."""
    drive = street(yaw_step=yaw_step)
    frames = run(build(f"cv+{association}_{map_}"), scans_of(drive))
    translations, angles = motion_errors(poses(frames), drive.T_world_lidar)
    assert translations.max() < (0.015 if map_ == "f2m" else 0.05) and angles.max() < 0.1
    assert torch.equal(poses(frames)[0], se3.identity())
    assert [frame.health.status for frame in frames] == ["ok"] * FRAMES
    assert not any(frame.health.flagged for frame in frames)
    assert [frame.health.frame for frame in frames] == list(range(FRAMES))


@pytest.mark.parametrize("initialization", ["ni", "cv", "ei"])
@kd_at_least
def test_every_initialization_drives_every_backend(initialization, association):
    drive = street()
    frames = run(build(f"{initialization}+{association}_f2m"), scans()[:6])
    translations, angles = motion_errors(poses(frames), drive.T_world_lidar[:6])
    assert translations.max() < 0.02 and angles.max() < 0.1
    sources = {frame.health.initialization for frame in frames[2:]}
    assert sources <= {initialization, "recovery"} | ({"cv"} if initialization == "ei" else set())


@cache
def first_scans(world: str, seed: int, scans: int) -> tuple[Drive, tuple[Tensor, ...]]:
    drive = Drive(world, seed=seed, frames=220)
    return drive, tuple(drive.scan(i).points for i in range(scans))


@pytest.mark.parametrize("association", ["p", pytest.param("kd", marks=slow), pytest.param("vh", marks=slow)])
def test_a_drive_that_begins_on_a_motorway_is_not_taken_to_stand_still(association):
    """At 80 km/h the ground and the barriers of two scans look most alike at rest: the rings lie on each other."""
    drive, scans = first_scans("highway", 7, 3)
    T_world_lidar = drive.T_world_lidar[:3]
    assert se3.relative(T_world_lidar)[0, 0, 3] > 2
    frames = run(build(f"cv+{association}_f2m"), scans)
    translations, _ = motion_errors(poses(frames), T_world_lidar)
    assert translations.max() < 0.05


@slow
@pytest.mark.parametrize("association", ["kd", "vh"])
def test_the_swinging_pitch_of_a_segway_is_followed_with_32_beams(association):
    drive, scans = first_scans("segway", 7, 60)
    T_world_lidar = drive.T_world_lidar[:60]
    frames = run(build(f"cv+{association}_f2m", projection="hdl32_inverted"), scans)
    translations, angles = motion_errors(poses(frames), T_world_lidar)
    assert translations.max() < 0.08 and angles.mean() < 0.3


@pytest.mark.parametrize("speed", [0.0, *(pytest.param(v, marks=slow) for v in (4.0, 12.0, 20.0)), 27.0])
@kd_at_least
def test_any_speed_is_found_at_the_start(association, speed):
    drive = street(4, step=speed / 10)
    frames = run(build(f"cv+{association}_f2m"), scans_of(drive))
    translations, _ = motion_errors(poses(frames), drive.T_world_lidar)
    assert translations.max() < 0.03
    assert frames[1].health.initialization == "start" and not frames[1].health.flagged


@pytest.mark.parametrize("name", ["vlp16", pytest.param("hdl32", marks=slow), pytest.param("os1_64", marks=slow)])
@kd_at_least
def test_any_spinning_lidar(association, name):
    drive = street(6, sensor=SENSORS[name])
    frames = run(build(f"cv+{association}_f2m", projection=name), scans_of(drive))
    translations, angles = motion_errors(poses(frames), drive.T_world_lidar)
    assert translations.max() < 0.05 and angles.max() < 0.3
    assert not any(frame.health.flagged for frame in frames)


# --- bad input ------------------------------------------------------------------------------------------------------

AT = 5  # the frame that is disturbed


def drive_with(disturbed: Tensor) -> list[Tensor]:
    return [*scans()[:AT], disturbed, *scans()[AT + 1 :]]


def assert_recovers(frames: list, true: Tensor, within: int = 3) -> None:
    """Finite everywhere, flagged at the disturbance, and right again soon after: absolutely, not only in its motion."""
    estimated = poses(frames)
    assert torch.isfinite(estimated).all()
    assert frames[AT].health.flagged
    assert not any(frame.health.flagged for frame in frames[:AT])
    assert not any(frame.health.flagged for frame in frames[AT + 1 + within :])
    errors = se3.log(se3.inverse(true) @ estimated)
    assert errors[AT + within :, :3].norm(dim=1).max() < 0.1
    assert errors[AT + within :, 3:].norm(dim=1).rad2deg().max() < 0.5


def not_finite(points: Tensor) -> Tensor:
    bad = points.clone()
    bad[::7] = math.nan
    bad[1::7, 1] = math.inf
    bad[2::7, 2] = -math.inf
    return bad


@kd_at_least
@pytest.mark.parametrize(
    "disturbed",
    [
        pytest.param(torch.zeros(0, 3), id="empty"),
        pytest.param(scans()[AT][::3200][:10], id="10 points"),
        pytest.param(torch.full((500, 3), math.nan), id="only nan", marks=slow),
        pytest.param(torch.zeros(500, 3), id="only zeros", marks=slow),
    ],
)
def test_a_scan_without_content_is_flagged_and_survived(association, disturbed):
    frames = run(build(f"cv+{association}_f2m"), drive_with(disturbed))
    assert_recovers(frames, street().T_world_lidar)
    assert frames[AT].health.status == "coasted"


@kd_at_least
def test_points_that_are_not_finite_are_left_out(association):
    frames = run(build(f"cv+{association}_f2m"), drive_with(not_finite(scans()[AT])))
    translations, _ = motion_errors(poses(frames), street().T_world_lidar)
    assert translations.max() < 0.03


@kd_at_least
def test_a_repeated_scan_is_flagged_and_recovered_from(association):
    frames = run(build(f"cv+{association}_f2m"), drive_with(scans()[AT - 1]))
    assert_recovers(frames, street().T_world_lidar)
    moved = se3.inverse(frames[AT - 1].T_world_lidar) @ frames[AT].T_world_lidar
    assert moved[:3, 3].norm() < 0.1


@kd_at_least
def test_a_dropped_scan_is_flagged_and_recovered_from(association):
    kept = [i for i in range(FRAMES) if i != AT]
    frames = run(build(f"cv+{association}_f2m"), [scans()[i] for i in kept])
    assert_recovers(frames, street().T_world_lidar[kept])


@kd_at_least
def test_a_turn_by_20_degrees_from_one_scan_to_the_next_is_flagged_and_recovered_from(association):
    T_straight_turned = se3.from_euler(torch.tensor([0, 0, 0, 0, 0, math.radians(20)], dtype=torch.float64))
    turned = se3.transform(se3.inverse(T_straight_turned), scans()[AT])
    frames = run(build(f"cv+{association}_f2m"), drive_with(turned))
    assert_recovers(frames, street().T_world_lidar)
    expected = street().T_world_lidar[AT] @ T_straight_turned
    error = se3.inverse(expected) @ frames[AT].T_world_lidar
    assert error[:3, 3].norm() < 0.1 and se3.rotation_angle(error).rad2deg() < 0.5


@kd_at_least
def test_a_world_turned_for_good_is_followed(association):
    """From one frame on every scan is turned: the sensor was knocked."""
    T_straight_turned = se3.from_euler(torch.tensor([0, 0, 0, 0, 0, math.radians(20)], dtype=torch.float64))
    turned = [se3.transform(se3.inverse(T_straight_turned), points) for points in scans()[AT:]]
    frames = run(build(f"cv+{association}_f2m"), [*scans()[:AT], *turned])
    true = street().T_world_lidar.clone()
    true[AT:] = true[AT:] @ T_straight_turned
    assert_recovers(frames, true)


@kd_at_least
@pytest.mark.parametrize("lead", [pytest.param(1, marks=slow), 3])
def test_a_drive_that_begins_with_empty_scans_starts_when_there_is_something_to_see(association, lead):
    frames = run(build(f"cv+{association}_f2m"), [*[torch.zeros(0, 3)] * lead, *scans()[:6]])
    assert torch.isfinite(poses(frames)).all()
    translations, _ = motion_errors(poses(frames)[lead:], street().T_world_lidar[:6])
    assert translations.max() < 0.03


@kd_at_least
def test_after_a_long_gap_a_new_map_is_begun_and_said_so(association):
    gap = [torch.zeros(0, 3)] * 6
    frames = run(build(f"cv+{association}_f2m"), [*scans()[:3], *gap, *scans()[9:]])
    statuses = [frame.health.status for frame in frames]
    assert statuses[3:8] == ["coasted"] * 5 and "restarted" in statuses[8:10]
    assert torch.isfinite(poses(frames)).all()
    translations, _ = motion_errors(poses(frames)[10:], street().T_world_lidar[10:])
    assert translations.max() < 0.05


# --- degenerate surroundings ----------------------------------------------------------------------------------------


def in_scene(name: str, sensor: str) -> Drive:
    world = {"corridor": scenes.corridor, "tunnel": scenes.tunnel, "street": scenes.street}[name]()
    return Drive(world, poses=scenes.straight_path(6, 1.2), frames=6, sensor=SENSORS[sensor])


@kd_at_least
@pytest.mark.parametrize("sensor", ["hdl64", pytest.param("hdl32", marks=slow)])
@pytest.mark.parametrize("name", ["corridor", "tunnel"])
def test_an_endless_corridor_is_flagged_along_its_axis_from_the_first_registered_frame(association, name, sensor):
    frames = run(build(f"cv+{association}_f2m", projection=sensor), scans_of(in_scene(name, sensor)))
    for frame in frames[1:]:
        assert frame.health.degenerate and frame.health.flagged
        assert abs(frame.health.weakest_direction[0]) > 0.99
    drift = se3.log(poses(frames))[:, 1:]
    assert drift[:, :2].norm(dim=1).max() < 0.1 and drift[:, 2:].norm(dim=1).rad2deg().max() < 1.0


@kd_at_least
@pytest.mark.parametrize("sensor", ["hdl64", pytest.param("hdl32", marks=slow)])
def test_an_open_street_is_not_flagged(association, sensor):
    frames = run(build(f"cv+{association}_f2m", projection=sensor), scans_of(in_scene("street", sensor)))
    assert not any(frame.health.flagged for frame in frames)


@pytest.mark.slow
@kd_at_least
@pytest.mark.parametrize("sensor", ["vlp16", "os1_64"])
@pytest.mark.parametrize("name", ["corridor", "tunnel"])
def test_noisier_sensors_see_a_corridor_too(association, name, sensor):
    frames = run(build(f"cv+{association}_f2m", projection=sensor), scans_of(in_scene(name, sensor)))
    # The image's normals of near walls are noisy; the more scans, the more of them pose as something ahead: 1.3 % of
    # the points after five scans of the OS1.
    surely = frames[1:3] if association == "p" else frames[1:]
    assert all(frame.health.degenerate for frame in surely)
    assert all(frame.health.min_information < 0.02 for frame in frames[1:])


# --- motion within a scan -------------------------------------------------------------------------------------------


@kd_at_least
def test_deskewing_mends_a_distorted_drive(association):
    path = scenes.straight_path(12, 1.2, yaw_step=0.05)
    drive = Drive(scenes.street(), poses=path, frames=9, sensor=SMALL, motion_distortion=True)
    with_times, without = build(f"cv+{association}_f2m"), build(f"cv+{association}_f2m")
    distorted = [drive.scan(i) for i in range(9)]
    mended = [with_times.register_scan(scan.points, scan.times) for scan in distorted]
    skewed = run(without, [scan.points for scan in distorted])
    better = motion_errors(poses(mended), drive.T_world_lidar)
    worse = motion_errors(poses(skewed), drive.T_world_lidar)
    assert better[0][2:].mean() < 0.015 and better[1][2:].mean() < 0.08
    assert better[0][2:].mean() < worse[0][2:].mean()


# --- long runs ------------------------------------------------------------------------------------------------------


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


def looping(odometry: ScanByScan, count: int) -> Iterator[Frame]:
    """The frames of an endless drive; on the way it must never be lost."""
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


@kd_at_least
def test_what_an_odometry_holds_stops_growing_when_its_window_is_full(association):
    odometry = build(f"cv+{association}_f2m", f"odometry.{association}_f2m.local_map.size=3", *TINY_IMAGE)
    held = [held_bytes(odometry, set()) for _ in looping(odometry, 40)]
    assert max(held[20:]) <= 1.02 * max(held[:20])


@pytest.mark.slow
@pytest.mark.parametrize("association", ["kd", "p"])
def test_memory_is_flat_over_3000_frames(association):
    """A minute long. The voxel hash keeps the very map that the KdTree is built of."""
    odometry = build(f"cv+{association}_f2m", *TINY_IMAGE)
    after_1000 = 0
    for frame in looping(odometry, 3_000):
        if frame.health.frame == 1000:
            after_1000 = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    growth_mib = (resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - after_1000) / 1024
    assert growth_mib < 40
    R = frame.T_world_lidar[:3, :3]
    torch.testing.assert_close(R @ R.T, torch.eye(3, dtype=torch.float64), rtol=0, atol=1e-12)


# --- small print ----------------------------------------------------------------------------------------------------


@kd_at_least
def test_the_same_scans_give_the_same_poses(association):
    first, again = (poses(run(build(f"cv+{association}_f2m"), scans()[:6])) for _ in range(2))
    assert torch.equal(first, again)


def test_an_initialization_alone_accumulates_its_guesses():
    drive = Drive("urban", seed=1, frames=5, speed=10.0, static=True, sensor=SENSORS["hdl64"])
    frames = run(build("ei"), scans_of(drive))
    assert torch.equal(frames[0].T_world_lidar, se3.identity())
    translations, _ = motion_errors(poses(frames), drive.T_world_lidar)
    assert translations.max() < 0.4
    assert {frame.health.initialization for frame in frames[1:]} == {"ei"}
    assert all(torch.equal(T, se3.identity()) for T in poses(run(build("ni"), scans()[:3])))


def test_returns_of_the_vehicle_itself_and_beyond_the_range_are_left_out():
    own_car = torch.rand(3000, 3, generator=torch.Generator().manual_seed(0)) - 0.5
    far = 150 * torch.nn.functional.normalize(torch.randn(300, 3, generator=torch.Generator().manual_seed(1)), dim=1)
    clean = run(build("cv+kd_f2m"), scans()[:5])
    cluttered = run(build("cv+kd_f2m"), [torch.cat([points, own_car, far]) for points in scans()[:5]])
    assert torch.equal(poses(clean), poses(cluttered))


def test_without_recovery_a_surprise_is_still_flagged():
    odometry = build("cv+kd_f2m", "pipeline.recovery=false")
    frames = run(odometry, [scans()[0], scans()[0], *[torch.zeros(0, 3)] * 2])
    assert [frame.health.status for frame in frames[2:]] == ["coasted"] * 2
    assert replace(frames[1].health, iterations=0) != frames[1].health


@pytest.mark.gpu
@pytest.mark.skipif(not torch.cuda.is_available(), reason="needs a CUDA device")
@kd_at_least
def test_cuda_gives_the_poses_of_the_cpu(association):
    on_cpu = poses(run(build(f"cv+{association}_f2m"), scans()[:8]))
    on_gpu = poses(run(build(f"cv+{association}_f2m", "device=cuda"), scans()[:8]))
    translations, angles = motion_errors(on_gpu, on_cpu)
    assert translations.max() < 2e-3 and angles.max() < 0.02
