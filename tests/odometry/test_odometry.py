"""Whole odometries, as configured, on generated drives: accurate from the first frame on."""

import math
from dataclasses import replace
from functools import cache

import numpy as np
import pytest
import torch
from hydra.errors import InstantiationException
from hydra.utils import instantiate
from torch import Tensor

from lidarlearn.geometry import se3
from lidarlearn.odometry import Backend, GridSampling, LocalMap, Odometry
from lidarlearn.odometry.beam_spacing import map_voxel_m
from lidarlearn.odometry.initialization import ConstantVelocity, Initialization, InitialMotion
from lidarlearn.odometry.initialization_only import InitializationOnly
from lidarlearn.registration.association import KdTree
from lidarlearn.registration.gauss_newton import GaussNewton
from lidarlearn.registration.residuals import GeneralizedIcp
from lidarlearn.simulation.drive import Drive
from lidarlearn.simulation.sensors import Sensor, hdl64
from tests import scenes
from tests.gpu import on_gpu
from tests.odometry.odometries import (
    ASSOCIATIONS,
    FRAMES,
    SENSORS,
    SMALL,
    build,
    composed,
    kd_at_least,
    motion_errors,
    poses,
    run,
    scans,
    scans_of,
    slow,
    street,
)


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


@kd_at_least
@pytest.mark.parametrize("step_m", [1.4, 2.7])
def test_a_sensor_that_looks_back_starts_at_speed_too(association, step_m):
    T_ahead_back = se3.from_euler(torch.tensor([0, 0, 0, 0, 0, math.pi], dtype=torch.float64))
    drive = street(step=step_m)
    frames = run(
        build(f"cv+{association}_f2m"),
        [se3.transform(se3.inverse(T_ahead_back), points) for points in scans_of(drive)[:4]],
    )
    translations, _ = motion_errors(poses(frames), se3.inverse(T_ahead_back) @ drive.T_world_lidar[:4] @ T_ahead_back)
    assert translations.max() < 0.03


def test_a_backend_forgets_another_drive():
    backend = Backend(GridSampling(), LocalMap(KdTree()))
    for _ in range(2):
        frames = run(Odometry(ConstantVelocity(), backend), scans()[:3])
        translations, _ = motion_errors(poses(frames), street().T_world_lidar[:3])
        assert translations.max() < 0.02 and torch.equal(poses(frames)[0], se3.identity())


def test_a_record_says_by_how_much_a_scan_is_skewed():
    class Skewed(Backend):
        def register(self, *arguments):
            skew = torch.tensor([0.03, 0.04, 0, 0, 0, math.radians(0.2)], dtype=torch.float64)
            return replace(super().register(*arguments), skew=skew)

    odometry = Odometry(ConstantVelocity(), Skewed(GridSampling(), LocalMap(KdTree())))
    health = run(odometry, scans()[:2])[1].health
    assert health.skew_m == pytest.approx(0.05) and health.skew_deg == pytest.approx(0.2)


@pytest.mark.parametrize("name", ["cv+kd_f2m", "ei"])
def test_a_pose_belongs_to_whom_it_was_given(name):
    """Who moves it into a frame of his own moves nothing else."""
    odometry, untouched = build(name), run(build(name), scans()[:3])
    for points, expected in zip(scans(), untouched, strict=False):
        pose = odometry.register_scan(points).T_world_lidar
        assert torch.equal(pose, expected.T_world_lidar)
        pose[:3, 3] += 100


@pytest.mark.parametrize("alone", [True, False])
def test_an_initialization_may_do_with_the_last_motion_what_it_likes(alone):
    class Spoiling(Initialization):
        def predict(self, points, last_motion):
            guess = ConstantVelocity().predict(points, last_motion.clone())
            last_motion.zero_()
            return guess

    def odometry(initialization):
        if alone:
            return InitializationOnly(initialization)
        return Odometry(initialization, Backend(GridSampling(), LocalMap(KdTree())))

    assert torch.equal(*(poses(run(odometry(i), scans()[:4])) for i in (Spoiling(), ConstantVelocity())))


@pytest.mark.parametrize(
    ("source", "error", "status"),
    [("start", [4.0, 2, 0, 0, 0, 0.3], "recovered"), ("recovery", [1.0, 0.5, 0, 0, 0, 0], "ok")],
)
def test_an_initialization_may_call_itself_what_it_likes(source, error, status):
    class Wrong(Initialization):
        def __init__(self, source):
            self.source = source

        def predict(self, points, last_motion):
            return InitialMotion(last_motion if last_motion[0, 3] < 1 else last_motion @ T_right_wrong, self.source)

    T_right_wrong = se3.from_euler(torch.tensor(error, dtype=torch.float64))
    backend = Backend(GridSampling(), LocalMap(KdTree()))
    frames, expected = (run(Odometry(Wrong(name), backend), scans()[:4]) for name in (source, "wrong"))
    assert torch.equal(poses(frames), poses(expected))
    assert [frame.health.status for frame in frames] == ["ok", "ok", status, status]


@pytest.mark.parametrize(
    ("setting", "value"),
    [
        ("sampling.map_voxel_m", 0.0),
        ("registration.max_step_m", 0.0),
        ("registration.weight.sigma_m", -0.1),
        ("hypothesis_points", 0),
    ],
)
def test_settings_that_nothing_can_be_done_with_are_refused(setting, value):
    with pytest.raises(InstantiationException, match=rf"{setting.rpartition('.')[2]}.* must be above 0, got"):
        build("cv+kd_f2m", f"odometry.kd_f2m.{setting}={value}")


def test_a_position_that_is_held_where_it_was_guessed_is_flagged():
    """However little may be known by the judgement: the registration's own threshold decides what is held."""
    odometry = build("cv+kd_f2m", "odometry.kd_f2m.registration.min_information=1.0", "pipeline.recovery=false")
    assert all(frame.health.degenerate for frame in run(odometry, scans()[:4])[1:])


@pytest.mark.parametrize("name", ["hdl64", "hdl32", "vlp16"])
def test_generalized_icp_has_normals_however_few_beams_there_are(name):
    points = street(sensor=SENSORS[name]).scan(0).points
    grid = GridSampling(map_voxel_m(instantiate(composed(f"projection@data.projection={name}").data.projection)))
    backend = Backend(grid, LocalMap(KdTree()), GaussNewton(residual=GeneralizedIcp()))
    scan = backend.sampling.sample(points)
    assert (backend.normals(scan.points, scan.queries) != 0).any(dim=1).float().mean() > 0.3


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
def first_scans(world: str, seed: int, scans: int, sensor: Sensor | None = None) -> tuple[Drive, tuple[Tensor, ...]]:
    drive = Drive(world, seed=seed, frames=220, sensor=sensor)
    return drive, tuple(drive.scan(i).points for i in range(scans))


@pytest.mark.parametrize("columns", [1024, pytest.param(2000, marks=slow)])
@pytest.mark.parametrize("association", ["p", "kd", pytest.param("vh", marks=slow)])
def test_a_drive_that_begins_on_a_motorway_is_not_taken_to_stand_still(association, columns):
    """At 80 km/h the ground and the barriers of two scans look most alike at rest: the rings lie on each other."""
    drive, scans = first_scans("highway", 7, 3, hdl64(columns))
    T_world_lidar = drive.T_world_lidar[:3]
    assert se3.relative(T_world_lidar)[0, 0, 3] > 2
    frames = run(build(f"cv+{association}_f2m"), scans)
    translations, _ = motion_errors(poses(frames), T_world_lidar)
    assert translations.max() < 0.05


@pytest.mark.parametrize(
    "method",
    ["cv+kd_f2f", "ni+kd_f2f", "ni+p_f2m"]
    + [pytest.param(m, marks=slow) for m in ("cv+vh_f2f", "cv+p_f2f", "ni+vh_f2f", "ni+p_f2f")],
)
def test_a_motorway_does_not_draw_to_rest(method):
    """Where few points have a partner, standing still agrees a little better with the rings than driving.

    Without an initialization every guess is more than 2 m off.
    """
    drive, scans = first_scans("highway", 7, 12)
    frames = run(build(method), scans)
    translations, _ = motion_errors(poses(frames), drive.T_world_lidar[:12])
    assert translations.max() < 0.1


@slow
@pytest.mark.parametrize("association", ["kd", "vh"])
def test_what_a_motorway_does_not_say_does_not_stay_as_guessed(association):
    """Without an initialization a registration may end half a metre short, and pass for a change of speed."""
    drive, part = Drive("highway", seed=2, frames=220, sensor=hdl64(1024)), range(76, 92)
    frames = run(build(f"ni+{association}_f2f"), (drive.scan(i).points for i in part))
    translations, _ = motion_errors(poses(frames), drive.T_world_lidar[part.start : part.stop])
    assert translations.max() < 0.1


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
    T_straight_turned = se3.from_euler(torch.tensor([0, 0, 0, 0, 0, math.radians(20)], dtype=torch.float64))
    turned = se3.transform(se3.inverse(T_straight_turned), scans()[5])
    frames = run(build("cv+kd_f2m", "pipeline.recovery=false"), [*scans()[:5], turned, torch.zeros(0, 3)])
    assert [frame.health.flagged for frame in frames] == [*[False] * 5, True, True]
    assert frames[5].health.initialization == "cv" and frames[6].health.status == "coasted"


@pytest.mark.parametrize(
    ("points", "times", "said"),
    [
        (torch.zeros(5, 4), None, r"points must be \(n, 3\).*\(5, 4\)"),
        (torch.zeros(3), None, r"points must be \(n, 3\).*\(3,\)"),
        (torch.zeros(5, 3), torch.zeros(4), r"times must be \(5,\).*\(4,\)"),
    ],
)
@pytest.mark.parametrize("method", ["cv+kd_f2m", "ei"])
def test_what_is_no_scan_is_refused(method, points, times, said):
    with pytest.raises(ValueError, match=said):
        build(method).register_scan(points, times)


def test_the_readmes_odometry_is_cv_kd_f2m():
    by_hand = Odometry(ConstantVelocity(), Backend(GridSampling(), LocalMap(KdTree())))
    assert torch.equal(poses(run(by_hand, scans()[:6])), poses(run(build("cv+kd_f2m"), scans()[:6])))


def test_scans_may_be_arrays_of_any_number_type():
    as_float32 = run(build("cv+kd_f2m"), scans()[:4])
    for array in (
        lambda points: points.double().numpy(),
        lambda points: points.flip(0).numpy()[::-1],
        lambda points: points.numpy().astype(">f4"),
        lambda points: np.frombuffer(points.numpy().tobytes(), np.float32).reshape(-1, 3),  # read-only
    ):
        as_arrays = run(build("cv+kd_f2m"), [array(points) for points in scans()[:4]])
        assert torch.equal(poses(as_float32), poses(as_arrays))


@on_gpu
@pytest.mark.parametrize("association", ASSOCIATIONS)
@pytest.mark.parametrize("map_", ["f2f", "f2m"])
def test_cuda_gives_the_poses_of_the_cpu(association, map_):
    here = poses(run(build(f"cv+{association}_{map_}"), scans()))
    there = poses(run(build(f"cv+{association}_{map_}", "device=cuda"), scans()))
    translations, angles = motion_errors(there, here)
    assert translations.max() < 2e-3 and angles.max() < 0.02
