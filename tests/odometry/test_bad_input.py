"""Scans that are empty, broken, repeated, missing or turned: flagged, survived, recovered from."""

import math

import pytest
import torch
from torch import Tensor

from lidarlearn.geometry import se3
from lidarlearn.simulation.drive import Drive
from tests import scenes
from tests.odometry.odometries import (
    FRAMES,
    SMALL,
    build,
    kd_at_least,
    motion_errors,
    poses,
    run,
    scans,
    scans_of,
    slow,
    street,
)

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
def test_scans_that_are_lost_again_and_again_at_90_km_h_are_recovered_from(association):
    """Constant velocity is 2.5 m off then, the distance of some ground rings, which fit."""
    drive = street(frames=24, step=2.5)
    kept = [i for i in range(24) if i % 3 != 2]
    frames = run(build(f"cv+{association}_f2m"), [drive.scan(i).points for i in kept])
    translations, _ = motion_errors(poses(frames), drive.T_world_lidar[kept])
    assert translations.max() < 0.05
    assert [frame.health.status for frame in frames[2:]] == ["recovered", "ok"] * 7


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
@pytest.mark.parametrize("step_m", [1.2, 2.7])
@pytest.mark.parametrize("lead", [pytest.param(1, marks=slow), 3])
def test_a_drive_that_begins_with_empty_scans_starts_when_there_is_something_to_see(association, lead, step_m):
    drive = street(step=step_m)
    frames = run(build(f"cv+{association}_f2m"), [*[torch.zeros(0, 3)] * lead, *scans_of(drive)[:6]])
    assert torch.isfinite(poses(frames)).all()
    assert [frame.health.status for frame in frames] == [*["coasted"] * lead, "restarted", *["ok"] * 5]
    translations, _ = motion_errors(poses(frames)[lead:], drive.T_world_lidar[:6])
    assert translations.max() < 0.03


@kd_at_least
def test_a_vehicle_that_has_set_off_during_a_gap_is_found_driving(association):
    drive = street(step=2.4)
    standing, *driving = scans_of(drive)[:6]
    frames = run(build(f"cv+{association}_f2m"), [*[standing] * 3, *[torch.zeros(0, 3)] * 6, *driving])
    assert frames[9].health.status == "restarted"
    translations, _ = motion_errors(poses(frames)[9:], drive.T_world_lidar[1:6])
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


def test_only_scans_in_a_row_count_towards_a_new_map():
    drive = [torch.zeros(0, 3) if i % 2 else points for i, points in enumerate(scans())]
    frames = run(build("cv+kd_f2m", "pipeline.judgement.restart_after=3"), drive)
    assert [frame.health.status for frame in frames] == ["ok", *["coasted", "ok"] * 6]


@kd_at_least
def test_points_with_stray_times_are_left_out(association):
    """In the end each pose is that of scans without these points."""
    drive = Drive(scenes.street(), poses=scenes.straight_path(7, 1.2), frames=4, sensor=SMALL, motion_distortion=True)
    whole, spoilt = build(f"cv+{association}_f2m"), build(f"cv+{association}_f2m")
    for scan in drive:
        times, strays = scan.times.clone(), torch.arange(len(scan.times)) % 9 == 0
        times[strays] = torch.tensor([1000.0, math.nan, -math.inf]).repeat(len(times))[: int(strays.sum())]
        expected = whole.register_scan(scan.points[~strays], scan.times[~strays])
        torch.testing.assert_close(spoilt.register_scan(scan.points, times).T_world_lidar, expected.T_world_lidar)


@pytest.mark.parametrize("unit", [1e5, 60.0])
def test_times_in_a_unit_of_their_own_are_refused(unit):
    times = unit * torch.linspace(-0.5, 0.5, len(scans()[0]))
    with pytest.raises(ValueError, match=rf"shares of the scan period.*are {-unit / 2:g} to {unit / 2:g}"):
        build("cv+kd_f2m").register_scan(scans()[0], times)


@kd_at_least
@pytest.mark.parametrize("rate_deg", [12.0, pytest.param(20.0, marks=slow)])
def test_a_sudden_turn_is_followed_though_it_distorts_the_scans(association, rate_deg):
    """As they are, these scans fit nowhere: within one the sensor turns by as much as from one to the next."""
    yaws = rate_deg * (torch.arange(16) - AT).clamp(min=0).double()
    parameters = torch.zeros(16, 6, dtype=torch.float64)
    parameters[:, 0], parameters[:, 5] = 0.3 * torch.arange(16), yaws.deg2rad()
    path = torch.from_numpy(scenes.straight_path(1, 0.0))[0] @ se3.from_euler(parameters)
    drive = Drive(scenes.street(), poses=path.numpy(), frames=12, sensor=SMALL, motion_distortion=True)
    odometry = build(f"cv+{association}_f2m")
    frames = [odometry.register_scan(scan.points, scan.times) for scan in drive]
    translations, angles = motion_errors(poses(frames), drive.T_world_lidar)
    assert angles.max() < 2.0 and angles[AT + 3 :].max() < 0.15 and translations[AT + 3 :].max() < 0.03
    assert frames[AT + 1].health.flagged and not any(frame.health.flagged for frame in frames[AT + 4 :])


@kd_at_least
@pytest.mark.parametrize(
    ("empty", "statuses"),
    [
        ((1, 2), ["ok", "coasted", "coasted", *["ok"] * 10]),
        ((3, 4, 5, 6, 7, 9), [*["ok"] * 3, *["coasted"] * 5, "restarted", "coasted", "ok", "ok", "ok"]),
    ],
)
def test_the_first_scan_is_compensated_where_a_map_was_begun(association, empty, statuses):
    """A motion is only known once another scan comes, which may not be the next one."""
    drive = Drive(scenes.street(), poses=scenes.straight_path(17, 1.2), frames=13, sensor=SMALL, motion_distortion=True)
    odometry, nothing = build(f"cv+{association}_f2m"), (torch.zeros(0, 3), torch.zeros(0))
    frames = [
        odometry.register_scan(*(nothing if i in empty else (scan.points, scan.times))) for i, scan in enumerate(drive)
    ]
    assert [frame.health.status for frame in frames] == statuses
    known = [i for i, status in enumerate(statuses) if status == "ok"]
    assert (poses(frames) - drive.T_world_lidar)[known, :3, 3].norm(dim=1).max() < 0.1
