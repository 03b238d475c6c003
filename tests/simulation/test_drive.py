import pickle
from dataclasses import replace

import numpy as np
import pytest
import torch
from scipy.spatial import cKDTree

from lidarlearn.errors import UserError
from lidarlearn.geometry import se3
from lidarlearn.simulation.drive import Drive
from lidarlearn.simulation.meshes import box, merge
from lidarlearn.simulation.movers import Mover
from lidarlearn.simulation.sensors import Sensor, hdl64
from lidarlearn.simulation.worlds import PRESETS, World
from tests import scenes

SENSOR = hdl64(columns=256)
CLEAN = Sensor("clean", tuple(np.linspace(20, -20, 24).tolist()), 360, 0.1, 0.1, 120.0, 0.0, 0.0, float("inf"))


@pytest.fixture(scope="module")
def highway() -> Drive:
    """The world that is built most quickly."""
    return Drive("highway", seed=0, frames=30, sensor=SENSOR)


@pytest.fixture(scope="module")
def constant_speed() -> Drive:
    return Drive("urban", seed=1, frames=30, speed=12.0, static=True, sensor=hdl64(columns=1024))


def _without_traffic(drive):
    poses = drive.trajectory.at(drive.timestamps.numpy())
    return Drive(World(drive.world.static), seed=drive.seed, poses=poses, frames=len(drive), sensor=drive.sensor)


@pytest.mark.parametrize("world", ["highway", *(pytest.param(w, marks=pytest.mark.slow) for w in ("urban", "campus"))])
def test_equal_seeds_give_equal_bytes_in_any_order(world):
    first, second = (Drive(world, seed=3, frames=30, sensor=SENSOR) for _ in range(2))
    for index in (2, 17):
        first.ranges(index)
    assert second.ranges(17).tobytes() == first.ranges(17).tobytes()
    assert second.ranges(2).tobytes() == first.ranges(2).tobytes()
    assert torch.equal(second.T_world_lidar, first.T_world_lidar)


def test_other_seed_gives_other_world_and_trajectory(highway):
    other = Drive("highway", seed=4, frames=30, sensor=SENSOR)
    assert (other.ranges(0) != highway.ranges(0)).mean() > 0.5
    assert not torch.allclose(other.T_world_lidar, highway.T_world_lidar, atol=0.1)


def test_ground_truth_is_float64_from_identity(highway):
    assert highway.T_world_lidar.dtype == torch.float64 and len(highway.T_world_lidar) == len(highway) == 30
    assert torch.equal(highway.T_world_lidar[0], torch.eye(4, dtype=torch.float64))
    assert torch.allclose(highway.timestamps, 0.1 * torch.arange(30, dtype=torch.float64))


def test_scans_are_float32_within_range(highway):
    scan = highway.scan(5)
    ranges = scan.points.norm(dim=1)
    assert scan.points.dtype == torch.float32 and scan.times is None
    assert len(ranges) > 0.7 * SENSOR.beams * SENSOR.columns
    assert ranges.min() >= SENSOR.min_range - 0.01 and ranges.max() <= SENSOR.max_range + 0.01
    assert torch.isfinite(scan.points).all()


def test_speed_is_constant_from_first_frame(constant_speed):
    steps = se3.relative(constant_speed.T_world_lidar)[:, :3, 3].norm(dim=1)
    assert steps == pytest.approx(np.full(29, 1.2), rel=0.02)


@pytest.mark.slow
def test_static_scans_overlap_under_ground_truth(constant_speed):
    T_0_2 = (se3.inverse(constant_speed.T_world_lidar[10]) @ constant_speed.T_world_lidar[12]).numpy()
    ref, new = (constant_speed.scan(i).points.double().numpy() for i in (10, 12))
    tree = cKDTree(ref)

    def overlap(T):
        moved = new @ T[:3, :3].T + T[:3, 3]
        upright = (moved[:, 2] > -1.2) & (np.linalg.norm(moved, axis=1) < 25)
        return np.median(tree.query(moved[upright])[0])

    sideways = T_0_2.copy()
    sideways[:3, 3] += [0.5, 0.3, 0.0]
    assert overlap(T_0_2) < 0.12
    assert overlap(T_0_2) < 0.6 * overlap(sideways)
    assert overlap(T_0_2) < 0.6 * overlap(np.eye(4))


def test_static_drive_keeps_trajectory_without_traffic(highway):
    static = Drive("highway", seed=0, frames=30, sensor=SENSOR, static=True)
    assert torch.equal(static.T_world_lidar, highway.T_world_lidar)
    assert not static.world.movers and highway.world.movers


def test_traffic_moves(highway):
    static = _without_traffic(highway)
    changed = [np.mean(highway.ranges(i)[:48] != static.ranges(i)[:48]) for i in range(0, 30, 6)]
    assert max(changed) > 0.005
    cars = [mover.position(0.0) for mover in highway.world.movers]
    later = [mover.position(1.0) for mover in highway.world.movers]
    speeds = [np.linalg.norm(b - a) for a, b in zip(cars, later, strict=True) if a is not None and b is not None]
    assert speeds and 15 < np.median(speeds) < 35


def test_movers_occlude_static_world(highway):
    sensor = replace(SENSOR, range_noise=0.0, drop_out=0.0, reach=float("inf"))
    poses = highway.trajectory.at(highway.timestamps.numpy())
    drive = Drive(highway.world, poses=poses, frames=30, sensor=sensor)
    static_drive = _without_traffic(drive)
    for i in range(0, 30, 10):
        ranges, static_ranges = drive.ranges(i).astype(int), static_drive.ranges(i).astype(int)
        both = (ranges > 0) & (static_ranges > 0)
        assert (ranges != static_ranges).any()
        assert (ranges[both] <= static_ranges[both]).all()


@pytest.mark.parametrize("distorted", [False, True])
@pytest.mark.parametrize("yaw", [0.0, 0.5])
@pytest.mark.parametrize(
    ("body", "y"),
    [(box(14.0, 2.5, 4.0), 4.0), (box(14.0, 2.5, 4.0), -11.0), (box(30.0, 20.0, 5.0), 2.0)],
    ids=["near", "far", "around the sensor"],
)
def test_mover_looks_like_static_body_at_its_place(body, y, yaw, distorted):
    """Also between the vertices of large triangles, and from inside."""
    turned = body.moved(yaw=yaw)
    lane = np.stack([np.linspace(-50, 50, 101), np.full(101, y), np.zeros(101)], axis=1)
    mover = Mover(turned, lane, np.array([-1.0, 100.0]), np.array([50.0, 50.0]))
    floor, poses = box(400.0, 400.0, 1.0, base=-1.0), scenes.straight_path(5, 1.5, start=-3.0, yaw_step=0.1)
    settings = {"poses": poses, "frames": 4, "sensor": CLEAN, "motion_distortion": distorted}
    moving = Drive(World(floor, (mover,)), **settings)
    standing = Drive(World(merge([floor, mover.at(0.0)])), **settings)
    alone = Drive(World(floor), **settings)
    for i in (0, 2):
        assert (standing.ranges(i) != alone.ranges(i)).sum() > 500
        assert (moving.ranges(i) == standing.ranges(i)).all()


def test_scan_of_corridor_lies_on_walls_and_floor():
    drive = Drive(scenes.corridor(width=8.0), poses=scenes.straight_path(3, 1.0), frames=3, sensor=CLEAN)
    points = drive.scan(1).points
    on_wall = (points[:, 1].abs() - 4.0).abs() < 2e-3
    on_floor = (points[:, 2] + scenes.SENSOR_HEIGHT).abs() < 2e-3
    assert (on_wall | on_floor).all() and on_wall.any() and on_floor.any()


def test_scans_of_endless_tunnel_are_equal():
    drive = Drive(scenes.tunnel(), poses=scenes.straight_path(2, 7.0), frames=2, sensor=CLEAN)
    still = Drive(scenes.tunnel(), poses=np.tile(scenes.straight_path(1, 0.0), (2, 1, 1)), frames=2, sensor=CLEAN)
    assert np.abs(drive.ranges(1).astype(int) - still.ranges(1).astype(int)).max() <= 2


@pytest.mark.parametrize("scene", [scenes.room, scenes.street])
def test_scenes_surround_sensor(scene):
    drive = Drive(scene(), poses=scenes.straight_path(2, 0.5), frames=2, sensor=CLEAN)
    assert len(drive.scan(0).points) > 0.6 * CLEAN.beams * CLEAN.columns


def test_given_poses_are_the_trajectory():
    poses = scenes.straight_path(20, 1.5, yaw_step=0.02)
    drive = Drive("highway", seed=0, frames=20, poses=poses, sensor=SENSOR)
    assert torch.allclose(drive.T_world_lidar, torch.from_numpy(np.linalg.inv(poses[0]) @ poses), atol=1e-9)
    ground = drive.scan(10).points[:, 2]
    assert np.percentile(ground.numpy(), 20) == pytest.approx(-scenes.SENSOR_HEIGHT, abs=0.4)


def test_motion_distortion_shifts_points_by_their_times():
    poses = scenes.straight_path(6, 2.0)
    world = World(box(60.0, 14.0, 4.0))
    still, bent = (
        Drive(world, poses=poses, frames=6, sensor=CLEAN, motion_distortion=flag).scan(3) for flag in (False, True)
    )
    assert still.times is None and bent.times is not None
    assert bent.times.min() >= -0.5 and bent.times.max() < 0.5 and len(bent.times) == len(bent.points)
    # Walls across the path at 24 and -36 m; each column measures from its own pose.
    x, y, z = bent.points.T
    at_scan_pose = x + 2.0 * bent.times
    across = (y.abs() < 6) & (z.abs() < 1.5)
    for wall, there in ((24.0, across & (x > 15)), (-36.0, across & (x < -15))):
        assert there.any() and (at_scan_pose[there] - wall).abs().max() < 0.01
    assert (x[across & (x < -15)] + 36.0).abs().max() > 0.5


def test_motion_distortion_is_zero_at_standstill():
    poses = np.tile(scenes.straight_path(1, 0.0), (4, 1, 1))
    a, b = (
        Drive(scenes.room(), poses=poses, frames=4, sensor=CLEAN, motion_distortion=flag).ranges(2)
        for flag in (False, True)
    )
    assert np.abs(a.astype(int) - b.astype(int)).max() <= 1


def test_drive_can_be_pickled_after_use():
    drive = Drive(scenes.room(), poses=scenes.straight_path(3, 0.5), frames=3, sensor=SENSOR)
    drive.ranges(0)
    assert pickle.loads(pickle.dumps(drive)).ranges(2).tobytes() == drive.ranges(2).tobytes()


@pytest.mark.parametrize(
    "change", [{"seed": 9}, {"frames": 7}, {"static": True}, {"speed": 5.0}, {"sensor": hdl64(128)}], ids=list
)
def test_fingerprint_depends_on_each_setting(change):
    settings = {"seed": 0, "frames": 5, "sensor": SENSOR}
    assert Drive("urban", **settings).fingerprint == Drive("urban", **settings).fingerprint
    assert Drive("urban", **settings).fingerprint != Drive("urban", **(settings | change)).fingerprint


def test_fingerprint_depends_on_all_of_given_world():
    ground, lane, times = box(80.0, 80.0, 0.1, base=-1.8), np.array([[5.0, -30, -1.7], [5, 30, -1.7]]), np.arange(3.0)
    bus = Mover(box(3.0, 3.0, 3.0), lane, times, 30 + times)
    worlds = [World(ground), World(replace(ground, triangles=ground.triangles[:6])), World(ground, (bus,))]
    changes = ({"mesh": box(3.0, 3.0, 2.0)}, {"lane": lane + 1}, {"times": times + 1}, {"travelled": times})
    worlds += [World(ground, (replace(bus, **change),)) for change in changes]
    poses = np.tile(np.eye(4), (4, 1, 1))
    fingerprints = [Drive(world, poses=poses, sensor=SENSOR).fingerprint for world in worlds]
    assert len(set(fingerprints)) == len(worlds)
    assert Drive(World(ground, (replace(bus),)), poses=poses, sensor=SENSOR).fingerprint == fingerprints[2]


def test_fingerprint_depends_on_simulator_code(monkeypatch):
    before = Drive("urban", seed=0, frames=5, sensor=SENSOR).fingerprint
    monkeypatch.setattr("lidarlearn.simulation.drive.source_digest", lambda *files, within: "of other code")
    assert Drive("urban", seed=0, frames=5, sensor=SENSOR).fingerprint != before


@pytest.mark.parametrize("world", ["urban", "segway", pytest.param("campus", marks=pytest.mark.slow)])
def test_scans_of_each_preset(world):
    drive = Drive(world, seed=0, frames=3, sensor=replace(PRESETS[world].sensor(), columns=128))
    assert len(drive.scan(1).points) > 0.4 * drive.sensor.beams * drive.sensor.columns


def test_invalid_arguments_are_refused(highway):
    with pytest.raises(UserError, match="choose one of urban"):
        Drive("moon")
    with pytest.raises(ValueError, match="at least one frame"):
        Drive("urban", frames=0)
    with pytest.raises(ValueError, match="needs poses"):
        Drive(scenes.room())
    with pytest.raises(IndexError, match="asked for 30"):
        highway.scan(30)
