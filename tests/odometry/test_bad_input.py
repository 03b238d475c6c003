"""Scans that are empty, broken, repeated, missing or turned: flagged, survived, recovered from."""

import copy
import math
from collections.abc import Iterable
from functools import cache

import pytest
import torch
from torch import Tensor

from lidarlearn.data.sequence import Scan
from lidarlearn.geometry import se3
from lidarlearn.odometry import Backend, GridSampling, LocalMap
from lidarlearn.odometry.base import BaseOdometry, Frame
from lidarlearn.registration.association import KdTree
from lidarlearn.simulation.drive import Drive
from tests import scenes
from tests.odometry.odometries import (
    ASSOCIATIONS,
    FRAMES,
    SMALL,
    build,
    distorted_scans,
    distorted_street,
    kd_fast_others_slow,
    motion_errors,
    poses,
    run,
    run_with_times,
    scans_of,
    slow,
    street,
    street_scans,
    yaw,
)

AT = 4  # the frame that is disturbed
EMPTY = torch.zeros(0, 3)
TURN = yaw(20)


@cache
def undisturbed(association: str) -> tuple[BaseOdometry, list[Frame]]:
    odometry = build(f"cv+{association}_f2m")
    return odometry, run(odometry, street_scans()[:AT])


def run_from_disturbance(association: str, scans: Iterable[Tensor]) -> list[Frame]:
    """All frames of a drive that is undisturbed before `AT`, and has these scans from then on."""
    odometry, before = undisturbed(association)
    return [*before, *run(copy.deepcopy(odometry), scans)]


def run_with_disturbed(association: str, scan: Tensor) -> list[Frame]:
    """All frames of a drive of which one scan is another one."""
    return run_from_disturbance(association, [scan, *street_scans()[AT + 1 :]])


def turned(points: Tensor) -> Tensor:
    """The points, seen by a sensor that is turned by `TURN`."""
    return se3.transform(se3.inverse(TURN), points)


def assert_recovers(frames: list[Frame], true: Tensor, within: int = 3) -> None:
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


@kd_fast_others_slow
@pytest.mark.parametrize(
    "disturbed",
    [
        pytest.param(lambda scan: EMPTY, id="empty"),
        pytest.param(lambda scan: scan[::3200][:10], id="10 points"),
        pytest.param(lambda scan: torch.full((500, 3), math.nan), id="only nan", marks=slow),
        pytest.param(lambda scan: torch.zeros(500, 3), id="only zeros", marks=slow),
    ],
)
def test_scan_without_content_is_flagged(association, disturbed):
    frames = run_with_disturbed(association, disturbed(street_scans()[AT]))
    assert_recovers(frames, street().T_world_lidar)
    assert frames[AT].health.status == "coasted"


@kd_fast_others_slow
def test_points_that_are_not_finite_are_dropped(association):
    bad = street_scans()[AT].clone()
    bad[::7] = math.nan
    bad[1::7, 1] = math.inf
    bad[2::7, 2] = -math.inf
    frames = run_from_disturbance(association, [bad, *street_scans()[AT + 1 : AT + 3]])
    translations, _ = motion_errors(poses(frames), street().T_world_lidar[: AT + 3])
    assert translations.max() < 0.03


@kd_fast_others_slow
def test_odometry_recovers_from_repeated_scan(association):
    frames = run_with_disturbed(association, street_scans()[AT - 1])
    assert_recovers(frames, street().T_world_lidar)
    moved = se3.inverse(frames[AT - 1].T_world_lidar) @ frames[AT].T_world_lidar
    assert moved[:3, 3].norm() < 0.1


@kd_fast_others_slow
def test_odometry_recovers_from_dropped_scan(association):
    kept = [i for i in range(FRAMES) if i != AT]
    frames = run_from_disturbance(association, street_scans()[AT + 1 :])
    assert_recovers(frames, street().T_world_lidar[kept])


@kd_fast_others_slow
def test_odometry_recovers_from_repeated_losses_at_90_km_h(association):
    """Constant velocity is 2.5 m off then, the distance of some ground rings, which fit."""
    drive = street(frames=9, step=2.5)
    kept = [i for i in range(9) if i % 3 != 2]
    frames = run(build(f"cv+{association}_f2m"), [drive.scan(i).points for i in kept])
    translations, _ = motion_errors(poses(frames), drive.T_world_lidar[kept])
    assert translations.max() < 0.05
    assert [frame.health.status for frame in frames[2:]] == ["recovered", "ok"] * 2


@kd_fast_others_slow
def test_odometry_recovers_from_turn_in_one_scan(association):
    frames = run_with_disturbed(association, turned(street_scans()[AT]))
    assert_recovers(frames, street().T_world_lidar)
    error = se3.inverse(street().T_world_lidar[AT] @ TURN) @ frames[AT].T_world_lidar
    assert error[:3, 3].norm() < 0.1 and se3.rotation_angle(error).rad2deg() < 0.5


@kd_fast_others_slow
def test_odometry_follows_lasting_turn_of_sensor(association):
    """As if the sensor had been knocked."""
    frames = run_from_disturbance(association, map(turned, street_scans()[AT:]))
    true = street().T_world_lidar.clone()
    true[AT:] = true[AT:] @ TURN
    assert_recovers(frames, true)


@kd_fast_others_slow
@pytest.mark.parametrize("step_m", [pytest.param(1.2, marks=slow), 2.7])
@pytest.mark.parametrize("lead", [pytest.param(1, marks=slow), 3])
def test_odometry_starts_after_empty_scans(association, lead, step_m):
    drive = street(frames=4, step=step_m)
    frames = run(build(f"cv+{association}_f2m"), [*[EMPTY] * lead, *scans_of(drive)])
    assert torch.isfinite(poses(frames)).all()
    assert [frame.health.status for frame in frames] == [*["coasted"] * lead, "restarted", *["ok"] * 3]
    translations, _ = motion_errors(poses(frames)[lead:], drive.T_world_lidar)
    assert translations.max() < 0.03


@kd_fast_others_slow
def test_restart_finds_motion_that_began_in_gap(association):
    drive = street(frames=4, step=2.4)
    standing, *driving = scans_of(drive)
    frames = run(build(f"cv+{association}_f2m"), [*[standing] * 3, *[EMPTY] * 6, *driving])
    assert frames[9].health.status == "restarted"
    translations, _ = motion_errors(poses(frames)[9:], drive.T_world_lidar[1:])
    assert translations.max() < 0.03


@kd_fast_others_slow
def test_long_gap_restarts_map(association):
    frames = run(build(f"cv+{association}_f2m"), [*street_scans()[:2], *[EMPTY] * 5, *street_scans()[7:]])
    assert [frame.health.status for frame in frames] == ["ok", "ok", *["coasted"] * 5, "restarted", "ok", "ok"]
    assert torch.isfinite(poses(frames)).all()
    translations, _ = motion_errors(poses(frames)[7:], street().T_world_lidar[7:])
    assert translations.max() < 0.05


def test_only_losses_in_a_row_restart_map():
    drive = [EMPTY if i % 2 else points for i, points in enumerate(street_scans()[:9])]
    frames = run(build("cv+kd_f2m", "pipeline.judgement.restart_after=3"), drive)
    assert [frame.health.status for frame in frames] == ["ok", *["coasted", "ok"] * 4]


@kd_fast_others_slow
def test_points_with_impossible_times_are_dropped(association):
    whole, spoilt = build(f"cv+{association}_f2m"), build(f"cv+{association}_f2m")
    for scan in distorted_scans()[:2]:
        times, strays = scan.times.clone(), torch.arange(len(scan.times)) % 9 == 0
        times[strays] = torch.tensor([1000.0, math.nan, -math.inf]).repeat(len(times))[: int(strays.sum())]
        expected = whole.register_scan(scan.points[~strays], scan.times[~strays])
        torch.testing.assert_close(spoilt.register_scan(scan.points, times).T_world_lidar, expected.T_world_lidar)


@pytest.mark.parametrize("unit", [1e5, 60.0])
def test_times_in_other_units_are_refused(unit):
    times = unit * torch.linspace(-0.5, 0.5, len(street_scans()[0]))
    with pytest.raises(ValueError, match=rf"shares of the scan period.*are {-unit / 2:g} to {unit / 2:g}"):
        build("cv+kd_f2m").register_scan(street_scans()[0], times)


def test_hypotheses_are_deskewed_by_their_motion():
    """As they are, scans of a fast turn fit nowhere."""
    path = scenes.straight_path(6, 0.3, yaw_step=math.radians(12))
    drive = Drive(scenes.street(), poses=path, frames=3, sensor=SMALL, motion_distortion=True)
    motion = se3.relative(drive.T_world_lidar)[1]
    backend = Backend(GridSampling(), LocalMap(KdTree()))
    before, scan = (backend.sampling.sample(drive.scan(i).points, drive.scan(i).times) for i in (1, 2))
    backend.local_map.update(before.deskewed(motion), se3.identity())
    guesses = torch.stack([yaw(8), yaw(16)])
    motions, agreements = backend.register_hypotheses(scan, guesses, se3.identity())
    errors = se3.inverse(motion) @ motions
    assert errors[:, :3, 3].norm(dim=1).max() < 0.05 and se3.rotation_angle(errors).rad2deg().max() < 0.3
    _, of_skewed = backend.register_hypotheses(scan, guesses, se3.identity(), deskews=False)
    assert agreements.min() > 1.2 * of_skewed.max()


@slow
@pytest.mark.parametrize("association", ASSOCIATIONS)
@pytest.mark.parametrize("rate_deg", [12.0, 20.0])
def test_odometry_follows_sudden_turn_that_distorts_scans(association, rate_deg):
    """Within a scan the sensor turns by as much as from one to the next."""
    yaws = rate_deg * (torch.arange(FRAMES + 4) - AT).clamp(min=0).double()
    parameters = torch.zeros(len(yaws), 6, dtype=torch.float64)
    parameters[:, 0], parameters[:, 5] = 0.3 * torch.arange(len(yaws)), yaws.deg2rad()
    path = torch.from_numpy(scenes.straight_path(1, 0.0))[0] @ se3.from_euler(parameters)
    drive = Drive(scenes.street(), poses=path.numpy(), frames=FRAMES, sensor=SMALL, motion_distortion=True)
    frames = run_with_times(build(f"cv+{association}_f2m"), drive)
    translations, angles = motion_errors(poses(frames), drive.T_world_lidar)
    assert angles.max() < 2.0 and angles[AT + 3 :].max() < 0.15 and translations[AT + 3 :].max() < 0.03
    assert frames[AT + 1].health.flagged and not any(frame.health.flagged for frame in frames[AT + 4 :])


@kd_fast_others_slow
@pytest.mark.parametrize(
    ("empty", "statuses"),
    [
        ((1, 2), ["ok", "coasted", "coasted", "ok", "ok", "ok"]),
        ((2, 3, 4, 5, 6, 8), ["ok", "ok", *["coasted"] * 5, "restarted", "coasted", "ok", "ok"]),
    ],
)
def test_first_scan_of_map_is_deskewed_after_lost_scans(association, empty, statuses):
    """Its motion is only known once another scan comes, which may not be the next one."""
    odometry, nothing = build(f"cv+{association}_f2m"), Scan(EMPTY, torch.zeros(0))
    scans = [nothing if i in empty else distorted_scans()[i] for i in range(len(statuses))]
    frames = run_with_times(odometry, scans)
    assert [frame.health.status for frame in frames] == statuses
    known = [i for i, status in enumerate(statuses) if status == "ok"]
    errors = (poses(frames) - distorted_street().T_world_lidar[: len(frames)])[known, :3, 3].norm(dim=1)
    assert errors.max() < 0.1
