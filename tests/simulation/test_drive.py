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
def urban() -> Drive:
    return Drive("urban", seed=3, frames=30, sensor=SENSOR)


@pytest.fixture(scope="module")
def static() -> Drive:
    return Drive("urban", seed=1, frames=30, speed=12.0, static=True, sensor=hdl64(columns=1024))


def _without_traffic(drive):
    poses = drive.trajectory.at(drive.timestamps.numpy())
    return Drive(World(drive.world.static), seed=drive.seed, poses=poses, frames=len(drive), sensor=drive.sensor)


def test_same_seed_same_bytes_in_any_order(urban):
    again = Drive("urban", seed=3, frames=30, sensor=SENSOR)
    assert again.ranges(17).tobytes() == urban.ranges(17).tobytes()
    assert again.ranges(2).tobytes() == urban.ranges(2).tobytes()
    assert torch.equal(again.T_world_lidar, urban.T_world_lidar)


@pytest.mark.slow
def test_other_seeds_give_other_worlds_and_other_ways(urban):
    other = Drive("urban", seed=4, frames=30, sensor=SENSOR)
    assert (other.ranges(0) != urban.ranges(0)).mean() > 0.5
    assert not torch.allclose(other.T_world_lidar, urban.T_world_lidar, atol=0.1)


def test_ground_truth_starts_at_the_identity_in_float64(urban):
    assert urban.T_world_lidar.dtype == torch.float64 and len(urban.T_world_lidar) == len(urban) == 30
    assert torch.equal(urban.T_world_lidar[0], torch.eye(4, dtype=torch.float64))
    assert torch.allclose(urban.timestamps, 0.1 * torch.arange(30, dtype=torch.float64))


def test_scans_are_float32_clouds_within_range(urban):
    scan = urban.scan(5)
    ranges = scan.points.norm(dim=1)
    assert scan.points.dtype == torch.float32 and scan.times is None
    assert len(ranges) > 0.7 * SENSOR.beams * SENSOR.columns
    assert ranges.min() >= SENSOR.min_range - 0.01 and ranges.max() <= SENSOR.max_range + 0.01
    assert torch.isfinite(scan.points).all()


def test_constant_speed_from_the_first_frame(static):
    steps = se3.relative(static.T_world_lidar)[:, :3, 3].norm(dim=1)
    assert steps == pytest.approx(np.full(29, 1.2), rel=0.02)


@pytest.mark.slow
def test_consecutive_static_scans_overlap_under_the_ground_truth(static):
    T_0_2 = (se3.inverse(static.T_world_lidar[10]) @ static.T_world_lidar[12]).numpy()
    ref, new = (static.scan(i).points.double().numpy() for i in (10, 12))
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


@pytest.mark.slow
def test_a_static_drive_takes_the_way_of_the_lively_one_without_its_traffic(urban):
    quiet = Drive("urban", seed=3, frames=30, sensor=SENSOR, static=True)
    assert torch.equal(quiet.T_world_lidar, urban.T_world_lidar)
    assert not quiet.world.movers and urban.world.movers


def test_traffic_moves():
    lively = Drive("highway", seed=0, frames=30, sensor=SENSOR)
    quiet = _without_traffic(lively)
    changed = [np.mean(lively.ranges(i)[:48] != quiet.ranges(i)[:48]) for i in range(0, 30, 6)]
    assert max(changed) > 0.005
    cars = [mover.position(0.0) for mover in lively.world.movers]
    later = [mover.position(1.0) for mover in lively.world.movers]
    speeds = [np.linalg.norm(b - a) for a, b in zip(cars, later, strict=True) if a is not None and b is not None]
    assert speeds and 15 < np.median(speeds) < 35


def test_movers_hide_what_is_behind_them(urban):
    sensor = replace(SENSOR, range_noise=0.0, drop_out=0.0, reach=float("inf"))
    poses = urban.trajectory.at(urban.timestamps.numpy())
    lively_drive = Drive(urban.world, poses=poses, frames=30, sensor=sensor)
    still_drive = _without_traffic(lively_drive)
    for i in range(0, 30, 10):
        lively, still = lively_drive.ranges(i).astype(int), still_drive.ranges(i).astype(int)
        both = (lively > 0) & (still > 0)
        assert (lively != still).any()
        assert (lively[both] <= still[both]).all()


@pytest.mark.parametrize("distorted", [False, True])
@pytest.mark.parametrize("yaw", [0.0, 0.5])
@pytest.mark.parametrize(
    ("body", "y"), [(box(14.0, 2.5, 4.0), 4.0), (box(14.0, 2.5, 4.0), -11.0), (box(30.0, 20.0, 5.0), 2.0)]
)
def test_what_could_move_looks_like_what_stands_there(body, y, yaw, distorted):
    """Sides of lorries are two triangles: between their vertices, too; and from within."""
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


def test_rays_hit_known_walls_exactly():
    drive = Drive(scenes.corridor(width=8.0), poses=scenes.straight_path(3, 1.0), frames=3, sensor=CLEAN)
    points = drive.scan(1).points
    on_wall = (points[:, 1].abs() - 4.0).abs() < 2e-3
    on_floor = (points[:, 2] + scenes.SENSOR_HEIGHT).abs() < 2e-3
    assert (on_wall | on_floor).all() and on_wall.any() and on_floor.any()


def test_a_tunnel_looks_the_same_everywhere():
    drive = Drive(scenes.tunnel(), poses=scenes.straight_path(2, 7.0), frames=2, sensor=CLEAN)
    still = Drive(scenes.tunnel(), poses=np.tile(scenes.straight_path(1, 0.0), (2, 1, 1)), frames=2, sensor=CLEAN)
    assert np.abs(drive.ranges(1).astype(int) - still.ranges(1).astype(int)).max() <= 2


@pytest.mark.parametrize("scene", [scenes.room(), scenes.street()])
def test_scenes_surround_the_sensor(scene):
    drive = Drive(scene, poses=scenes.straight_path(2, 0.5), frames=2, sensor=CLEAN)
    assert len(drive.scan(0).points) > 0.6 * CLEAN.beams * CLEAN.columns


def test_a_given_path_is_driven_exactly():
    poses = scenes.straight_path(20, 1.5, yaw_step=0.02)
    drive = Drive("campus", seed=0, frames=20, poses=poses, sensor=SENSOR)
    assert torch.allclose(drive.T_world_lidar, torch.from_numpy(np.linalg.inv(poses[0]) @ poses), atol=1e-9)
    ground = drive.scan(10).points[:, 2]
    assert np.percentile(ground.numpy(), 20) == pytest.approx(-scenes.SENSOR_HEIGHT, abs=0.4)


def test_distortion_bends_scans_by_the_motion_and_gives_times():
    poses = scenes.straight_path(6, 2.0)
    world = World(box(60.0, 14.0, 4.0))
    still, bent = (
        Drive(world, poses=poses, frames=6, sensor=CLEAN, motion_distortion=flag).scan(3) for flag in (False, True)
    )
    assert still.times is None and bent.times is not None
    assert bent.times.min() >= -0.5 and bent.times.max() < 0.5 and len(bent.times) == len(bent.points)
    # The walls across the path, at 24 and -36 m, seen by every column from where it was fired.
    x, y, z = bent.points.T
    at_scan_pose = x + 2.0 * bent.times
    across = (y.abs() < 6) & (z.abs() < 1.5)
    for wall, there in ((24.0, across & (x > 15)), (-36.0, across & (x < -15))):
        assert there.any() and (at_scan_pose[there] - wall).abs().max() < 0.01
    assert (x[across & (x < -15)] + 36.0).abs().max() > 0.5


def test_distortion_changes_nothing_at_standstill():
    poses = np.tile(scenes.straight_path(1, 0.0), (4, 1, 1))
    a, b = (
        Drive(scenes.room(), poses=poses, frames=4, sensor=CLEAN, motion_distortion=flag).ranges(2)
        for flag in (False, True)
    )
    assert np.abs(a.astype(int) - b.astype(int)).max() <= 1


def test_a_used_drive_can_be_sent_to_a_worker():
    drive = Drive(scenes.room(), poses=scenes.straight_path(3, 0.5), frames=3, sensor=SENSOR)
    drive.ranges(0)
    assert pickle.loads(pickle.dumps(drive)).ranges(2).tobytes() == drive.ranges(2).tobytes()


@pytest.mark.parametrize(
    "change", [{"seed": 9}, {"frames": 7}, {"static": True}, {"speed": 5.0}, {"sensor": hdl64(128)}]
)
def test_the_fingerprint_knows_every_setting(change):
    settings = {"seed": 0, "frames": 5, "sensor": SENSOR}
    assert Drive("urban", **settings).fingerprint == Drive("urban", **settings).fingerprint
    assert Drive("urban", **settings).fingerprint != Drive("urban", **(settings | change)).fingerprint


def test_the_fingerprint_knows_all_of_a_world_of_ones_own():
    ground, lane, times = box(80.0, 80.0, 0.1, base=-1.8), np.array([[5.0, -30, -1.7], [5, 30, -1.7]]), np.arange(3.0)
    bus = Mover(box(3.0, 3.0, 3.0), lane, times, 30 + times)
    worlds = [World(ground), World(replace(ground, triangles=ground.triangles[:6])), World(ground, (bus,))]
    changes = ({"mesh": box(3.0, 3.0, 2.0)}, {"lane": lane + 1}, {"times": times + 1}, {"travelled": times})
    worlds += [World(ground, (replace(bus, **change),)) for change in changes]
    poses = np.tile(np.eye(4), (4, 1, 1))
    fingerprints = [Drive(world, poses=poses, sensor=SENSOR).fingerprint for world in worlds]
    assert len(set(fingerprints)) == len(worlds)
    assert Drive(World(ground, (replace(bus),)), poses=poses, sensor=SENSOR).fingerprint == fingerprints[2]


def test_the_fingerprint_knows_the_simulator(monkeypatch):
    before = Drive("urban", seed=0, frames=5, sensor=SENSOR).fingerprint
    monkeypatch.setattr("lidarlearn.simulation.drive.source_digest", lambda *files, within: "of other code")
    assert Drive("urban", seed=0, frames=5, sensor=SENSOR).fingerprint != before


@pytest.mark.parametrize("world", ["campus", "segway"])
def test_every_preset_makes_scans(world):
    drive = Drive(world, seed=0, frames=3, sensor=replace(PRESETS[world].sensor(), columns=128))
    assert len(drive.scan(1).points) > 0.4 * drive.sensor.beams * drive.sensor.columns


def test_unusable_arguments_are_refused(urban):
    with pytest.raises(UserError, match="choose one of urban"):
        Drive("moon")
    with pytest.raises(ValueError, match="at least one frame"):
        Drive("urban", frames=0)
    with pytest.raises(ValueError, match="needs poses"):
        Drive(scenes.room())
    with pytest.raises(IndexError, match="asked for 30"):
        urban.scan(30)
