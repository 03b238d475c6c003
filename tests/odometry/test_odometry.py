"""Configured odometries on simulated drives."""

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
    SENSORS,
    SMALL,
    build,
    configured,
    kd_fast_others_slow,
    motion_errors,
    poses,
    run,
    run_with_times,
    scans_of,
    slow,
    street,
    street_frames,
    street_scans,
    yaw,
)

FAST_SCANS = 4  # of a motorway


@pytest.mark.parametrize("association", ["kd", "p", pytest.param("vh", marks=slow)])
@pytest.mark.parametrize("map_", ["f2m", pytest.param("f2f", marks=slow)])
@pytest.mark.parametrize("yaw_step", [pytest.param(0.0, marks=slow), 0.03])
def test_odometry_is_accurate_from_first_frame(association, map_, yaw_step):
    """12 m/s and up to 17 deg/s, with no prior for the second scan."""
    drive = street(frames=6, yaw_step=yaw_step)
    frames = run(build(f"cv+{association}_{map_}"), scans_of(drive))
    translations, angles = motion_errors(poses(frames), drive.T_world_lidar)
    assert translations.max() < (0.015 if map_ == "f2m" else 0.05) and angles.max() < 0.1
    assert torch.equal(poses(frames)[0], se3.identity())
    assert [frame.health.status for frame in frames] == ["ok"] * 6
    assert not any(frame.health.flagged for frame in frames)
    assert [frame.health.frame for frame in frames] == list(range(6))
    assert {frame.health.initialization for frame in frames[2:]} == {"cv"}


@kd_fast_others_slow
@pytest.mark.parametrize("step_m", [pytest.param(1.4, marks=slow), 2.7])
def test_backward_facing_sensor_starts_at_speed(association, step_m):
    T_ahead_back, drive = yaw(180), street(frames=4, step=step_m)
    scans = [se3.transform(se3.inverse(T_ahead_back), points) for points in scans_of(drive)]
    frames = run(build(f"cv+{association}_f2m"), scans)
    translations, _ = motion_errors(poses(frames), se3.inverse(T_ahead_back) @ drive.T_world_lidar @ T_ahead_back)
    assert translations.max() < 0.03


def test_new_odometry_clears_map_of_backend():
    backend = Backend(GridSampling(), LocalMap(KdTree()))
    run(Odometry(ConstantVelocity(), backend), street_scans()[5:7])
    frames = run(Odometry(ConstantVelocity(), backend), street_scans()[:3])
    assert torch.equal(poses(frames), poses(street_frames("cv+kd_f2m")[:3]))


def test_health_reports_size_of_skew():
    class Skewed(Backend):
        def register(self, *arguments):
            skew = torch.tensor([0.03, 0.04, 0, 0, 0, math.radians(0.2)], dtype=torch.float64)
            return replace(super().register(*arguments), skew=skew)

    odometry = Odometry(ConstantVelocity(), Skewed(GridSampling(), LocalMap(KdTree())), recovery=False)
    health = run(odometry, street_scans()[:2])[1].health
    assert health.skew_m == pytest.approx(0.05) and health.skew_deg == pytest.approx(0.2)


@pytest.mark.parametrize("name", ["cv+kd_f2m", "ei"])
def test_returned_pose_may_be_modified(name):
    odometry, untouched = build(name), street_frames(name)
    for points, expected in zip(street_scans()[:3], untouched, strict=False):
        pose = odometry.register_scan(points).T_world_lidar
        assert torch.equal(pose, expected.T_world_lidar)
        pose[:3, 3] += 100


@pytest.mark.parametrize("alone", [True, False])
def test_initialization_may_modify_last_motion(alone):
    class Spoiling(Initialization):
        def predict(self, points, last_motion):
            guess = ConstantVelocity().predict(points, last_motion.clone())
            last_motion.zero_()
            return guess

    if alone:
        odometry, expected = InitializationOnly(Spoiling()), se3.identity(4)
    else:
        backend = Backend(GridSampling(), LocalMap(KdTree()))
        odometry, expected = Odometry(Spoiling(), backend), poses(street_frames("cv+kd_f2m")[:4])
    assert torch.equal(poses(run(odometry, street_scans()[:4])), expected)


def test_name_of_initialization_changes_nothing():
    """Not even a name that health records use themselves."""
    errors = torch.tensor([[0] * 6, [0] * 6, [4, 2, 0, 0, 0, 0.3], [1, 0.5, 0, 0, 0, 0]], dtype=torch.float64)

    class Wrong(Initialization):
        def __init__(self, source):
            self.source, self.errors = source, iter(errors)

        def predict(self, points, last_motion):
            return InitialMotion(last_motion @ se3.from_euler(next(self.errors)), self.source)

    backend = Backend(GridSampling(), LocalMap(KdTree()))
    starts, recoveries = (run(Odometry(Wrong(name), backend), street_scans()[:4]) for name in ("start", "recovery"))
    assert torch.equal(poses(starts), poses(recoveries))
    for frames in (starts, recoveries):
        assert [frame.health.status for frame in frames] == ["ok", "ok", "recovered", "ok"]


@pytest.mark.parametrize(
    ("setting", "value"),
    [
        ("sampling.map_voxel_m", 0.0),
        ("registration.max_step_m", 0.0),
        ("registration.weight.sigma_m", -0.1),
        ("hypothesis_points", 0),
    ],
)
def test_impossible_settings_are_refused(setting, value):
    with pytest.raises(InstantiationException, match=rf"{setting.rpartition('.')[2]}.* must be above 0, got"):
        build("cv+kd_f2m", f"odometry.kd_f2m.{setting}={value}")


def test_position_held_at_its_guess_is_flagged():
    """The registration's threshold decides what is held, whatever that of the judgement."""
    odometry = build("cv+kd_f2m", "odometry.kd_f2m.registration.min_information=1.0", "pipeline.recovery=false")
    assert all(frame.health.degenerate for frame in run(odometry, street_scans()[:3])[1:])


@pytest.mark.parametrize("name", ["vlp16", *(pytest.param(name, marks=slow) for name in ("hdl32", "hdl64"))])
def test_generalized_icp_has_normals_for_every_sensor(name):
    points = street(sensor=SENSORS[name]).scan(0).points
    grid = GridSampling(map_voxel_m(instantiate(configured(projection=name).data.projection)))
    backend = Backend(grid, LocalMap(KdTree()), GaussNewton(residual=GeneralizedIcp()))
    scan = backend.sampling.sample(points)
    assert (backend.normals(scan.points, scan.queries) != 0).any(dim=1).float().mean() > 0.3


@pytest.mark.parametrize("initialization", [pytest.param("ni", marks=slow), "ei"])
@kd_fast_others_slow
def test_every_initialization_works_with_every_backend(initialization, association):
    frames = run(build(f"{initialization}+{association}_f2m"), street_scans()[:4])
    translations, angles = motion_errors(poses(frames), street().T_world_lidar[:4])
    assert translations.max() < 0.02 and angles.max() < 0.1
    sources = {frame.health.initialization for frame in frames[2:]}
    assert sources <= {initialization, "recovery"} | ({"cv"} if initialization == "ei" else set())


@cache
def first_scans(world: str, seed: int, scans: int, sensor: Sensor | None = None) -> tuple[Drive, tuple[Tensor, ...]]:
    drive = Drive(world, seed=seed, frames=220, sensor=sensor)
    return drive, tuple(drive.scan(i).points for i in range(scans))


@pytest.mark.parametrize("columns", [1024, pytest.param(2000, marks=slow)])
@pytest.mark.parametrize("association", ["p", "kd", pytest.param("vh", marks=slow)])
def test_start_on_motorway_is_not_taken_for_standstill(association, columns):
    """At 80 km/h the ground and the barriers of two scans look most alike at rest: the rings lie on each other."""
    drive, scans = first_scans("highway", 7, FAST_SCANS, hdl64(columns))
    T_world_lidar = drive.T_world_lidar[:3]
    assert se3.relative(T_world_lidar)[0, 0, 3] > 2
    frames = run(build(f"cv+{association}_f2m"), scans[:3])
    translations, _ = motion_errors(poses(frames), T_world_lidar)
    assert translations.max() < 0.05


MOTORWAY_METHODS = ("cv+kd_f2f", "cv+vh_f2f", "cv+p_f2f", "ni+kd_f2f", "ni+vh_f2f", "ni+p_f2f", "ni+p_f2m")


@pytest.mark.parametrize(
    ("method", "count", "sensor"),
    [
        ("ni+kd_f2f", FAST_SCANS, hdl64(1024)),
        *(pytest.param(method, 12, None, marks=slow) for method in MOTORWAY_METHODS),
    ],
)
def test_registration_on_motorway_is_not_drawn_to_standstill(method, count, sensor):
    """Where few points have a partner, standing still agrees a little better with the rings than driving.

    Without an initialization every guess is more than 2 m off.
    """
    drive, scans = first_scans("highway", 7, count, sensor)
    frames = run(build(method), scans)
    translations, _ = motion_errors(poses(frames), drive.T_world_lidar[:count])
    assert translations.max() < 0.1


@slow
@pytest.mark.parametrize("association", ["kd", "vh"])
def test_motion_along_motorway_does_not_stay_as_guessed(association):
    """Without an initialization a registration may end half a metre short, and pass for a change of speed."""
    drive, part = Drive("highway", seed=2, frames=220, sensor=hdl64(1024)), range(76, 92)
    frames = run(build(f"ni+{association}_f2f"), (drive.scan(i).points for i in part))
    translations, _ = motion_errors(poses(frames), drive.T_world_lidar[part.start : part.stop])
    assert translations.max() < 0.1


@slow
@pytest.mark.parametrize("association", ["kd", "vh"])
def test_odometry_follows_pitching_segway_with_32_beams(association):
    drive, scans = first_scans("segway", 7, 60)
    T_world_lidar = drive.T_world_lidar[:60]
    frames = run(build(f"cv+{association}_f2m", projection="hdl32_inverted"), scans)
    translations, angles = motion_errors(poses(frames), T_world_lidar)
    assert translations.max() < 0.08 and angles.mean() < 0.3


@pytest.mark.parametrize("speed", [0.0, *(pytest.param(v, marks=slow) for v in (4.0, 12.0, 20.0)), 27.0])
@kd_fast_others_slow
def test_start_finds_any_speed(association, speed):
    drive = street(3, step=speed / 10)
    frames = run(build(f"cv+{association}_f2m"), scans_of(drive))
    translations, _ = motion_errors(poses(frames), drive.T_world_lidar)
    assert translations.max() < 0.03
    assert frames[1].health.initialization == "start" and not frames[1].health.flagged


@pytest.mark.parametrize("name", ["vlp16", pytest.param("hdl32", marks=slow), pytest.param("os1_64", marks=slow)])
@kd_fast_others_slow
def test_odometry_is_accurate_with_every_sensor(association, name):
    drive = street(5, sensor=SENSORS[name])
    frames = run(build(f"cv+{association}_f2m", projection=name), scans_of(drive))
    translations, angles = motion_errors(poses(frames), drive.T_world_lidar)
    assert translations.max() < 0.05 and angles.max() < 0.3
    assert not any(frame.health.flagged for frame in frames)


@kd_fast_others_slow
def test_deskewing_corrects_distorted_drive(association):
    path = scenes.straight_path(9, 1.2, yaw_step=0.05)
    drive = Drive(scenes.street(), poses=path, frames=5, sensor=SMALL, motion_distortion=True)
    scans = list(drive)
    deskewed = run_with_times(build(f"cv+{association}_f2m"), scans)
    skewed = run(build(f"cv+{association}_f2m"), [scan.points for scan in scans])
    better = motion_errors(poses(deskewed), drive.T_world_lidar)
    worse = motion_errors(poses(skewed), drive.T_world_lidar)
    assert better[0][2:].mean() < 0.015 and better[1][2:].mean() < 0.08
    assert better[0][2:].mean() < worse[0][2:].mean()


@kd_fast_others_slow
def test_same_scans_give_same_poses(association):
    name = f"cv+{association}_f2m"
    assert torch.equal(poses(run(build(name), street_scans()[:4])), poses(street_frames(name)[:4]))


def test_points_on_vehicle_or_out_of_range_are_dropped():
    own_car = torch.rand(3000, 3, generator=torch.Generator().manual_seed(0)) - 0.5
    far = 150 * torch.nn.functional.normalize(torch.randn(300, 3, generator=torch.Generator().manual_seed(1)), dim=1)
    cluttered = run(build("cv+kd_f2m"), [torch.cat([points, own_car, far]) for points in street_scans()[:3]])
    assert torch.equal(poses(cluttered), poses(street_frames("cv+kd_f2m")[:3]))


def test_implausible_motion_is_flagged_without_recovery():
    turned = se3.transform(yaw(-20), street_scans()[3])
    frames = run(build("cv+kd_f2m", "pipeline.recovery=false"), [*street_scans()[:3], turned, torch.zeros(0, 3)])
    assert [frame.health.flagged for frame in frames] == [*[False] * 3, True, True]
    assert frames[3].health.initialization == "cv" and frames[4].health.status == "coasted"


@pytest.mark.parametrize(
    ("points", "times", "message"),
    [
        (torch.zeros(5, 4), None, r"points must be \(n, 3\).*\(5, 4\)"),
        (torch.zeros(3), None, r"points must be \(n, 3\).*\(3,\)"),
        (torch.zeros(5, 3), torch.zeros(4), r"times must be \(5,\).*\(4,\)"),
    ],
)
@pytest.mark.parametrize("method", ["cv+kd_f2m", "ei"])
def test_wrong_shapes_are_refused(method, points, times, message):
    with pytest.raises(ValueError, match=message):
        build(method).register_scan(points, times)


def test_scans_may_be_arrays_of_any_number_type():
    conversions = (
        lambda points: points.double().numpy(),
        lambda points: points.flip(0).numpy()[::-1],
        lambda points: points.numpy().astype(">f4"),
        lambda points: np.frombuffer(points.numpy().tobytes(), np.float32).reshape(-1, 3),  # read-only
    )
    arrays = [convert(points) for convert, points in zip(conversions, street_scans(), strict=False)]
    assert torch.equal(poses(run(build("cv+kd_f2m"), arrays)), poses(street_frames("cv+kd_f2m")[:4]))


@on_gpu
@pytest.mark.parametrize("association", ASSOCIATIONS)
@pytest.mark.parametrize("map_", ["f2f", "f2m"])
def test_cuda_gives_poses_of_cpu(association, map_):
    here = poses(street_frames(f"cv+{association}_{map_}"))
    there = poses(run(build(f"cv+{association}_{map_}", "device=cuda"), street_scans()[:6]))
    translations, angles = motion_errors(there, here)
    assert translations.max() < 2e-3 and angles.max() < 0.02
