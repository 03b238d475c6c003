from dataclasses import replace

import numpy as np
import pytest

from lidarlearn.simulation.sensors import RANGE_STEP, Sensor, hdl32, hdl32_inverted, hdl64, os1_64, vlp16

CLEAN = Sensor("clean", (2.0, -10.0), 1000, range_noise=0.0, drop_out=0.0, reach=float("inf"))


def _measure(sensor, distance, cos=1.0, shape=(2, 50000)):
    full = np.full(shape, distance, dtype=np.float32)
    return sensor.measure(full, np.full(shape, cos, dtype=np.float32), np.random.default_rng(0))


def test_clean_ranges_are_exact_to_half_a_step():
    assert abs(_measure(CLEAN, 12.3456) * RANGE_STEP - 12.3456).max() <= RANGE_STEP / 2


def test_noise_has_zero_mean_and_given_deviation():
    ranges = _measure(replace(CLEAN, range_noise=0.03), 20.0) * RANGE_STEP
    assert ranges.mean() == pytest.approx(20.0, abs=5e-4)
    assert ranges.std() == pytest.approx(0.03, rel=0.02)


@pytest.mark.parametrize("share", [0.0, 0.1, 0.5, 1.0])
def test_drop_out_has_given_share(share):
    assert (_measure(replace(CLEAN, drop_out=share), 20.0) == 0).mean() == pytest.approx(share, abs=0.01)


def test_returns_are_lost_at_reach_and_grazing_angles():
    sensor = replace(CLEAN, reach=60.0)
    assert (_measure(sensor, 60.0) > 0).mean() == pytest.approx(0.5, abs=0.01)
    assert (_measure(sensor, 60.0, cos=0.25) > 0).mean() == pytest.approx(0.2, abs=0.01)


@pytest.mark.parametrize("distance", [0.5, 120.5, np.inf])
def test_ranges_outside_limits_give_no_return(distance):
    assert not _measure(CLEAN, distance).any()


def test_points_lie_on_beams_at_measured_ranges():
    ranges = np.full((2, 1000), round(10 / RANGE_STEP), dtype=np.uint16)
    ranges[0, :] = 0
    points, times = CLEAN.points(ranges, index=0)
    assert points.dtype == np.float32 and points.shape == (1000, 3)
    assert np.linalg.norm(points, axis=1) == pytest.approx(10.0, abs=1e-5)
    assert np.degrees(np.arcsin(points[:, 2] / 10)) == pytest.approx(-10.0, abs=1e-4)
    assert times.min() == -0.5 and times.max() < 0.5


def test_sweep_runs_from_rear_over_left_to_front_at_time_0():
    points, times = CLEAN.points(np.full((2, 1000), 1000, dtype=np.uint16), index=0)
    forward = points[np.abs(times) < 1e-6][0]
    left = points[np.abs(times + 0.25) < 1e-6][0]
    assert forward[0] > 0 and abs(forward[1]) < 1e-5
    assert left[1] > 0 and abs(left[0]) < 1e-5


def test_azimuths_shift_between_scans_by_part_of_a_column():
    shifts = (CLEAN.azimuths(0)[0] - np.array([CLEAN.azimuths(i)[0] for i in range(50)])) / (2 * np.pi / 1000)
    assert shifts.min() >= 0 and shifts.max() < 1 and len(np.unique(shifts.round(6))) == 50


def test_directions_are_rotated_into_world():
    R = np.array([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]])
    assert CLEAN.directions(0, R[None]) == pytest.approx(CLEAN.directions(0) @ R.T, abs=1e-6)


@pytest.mark.parametrize(
    ("sensor", "beams", "top", "bottom"),
    [
        (hdl64(), 64, 2.0, -24.33),
        (hdl32(), 32, 10.67, -30.67),
        (hdl32_inverted(), 32, 30.67, -10.67),
        (vlp16(), 16, 15.0, -15.0),
        (os1_64(), 64, 21.2, -21.2),
    ],
    ids=["hdl64", "hdl32", "hdl32_inverted", "vlp16", "os1_64"],
)
def test_sensor_models_have_beams_of_data_sheets(sensor, beams, top, bottom):
    assert sensor.beams == beams
    assert (sensor.elevations_deg[0], sensor.elevations_deg[-1]) == pytest.approx((top, bottom))
    assert (np.diff(sensor.elevations_deg) < 0).all()


@pytest.mark.parametrize(
    "wrong", [{"max_range": 200.0}, {"columns": 0}, {"drop_out": 1.5}, {"min_range": 130.0}], ids=str
)
def test_impossible_sensor_settings_are_refused(wrong):
    with pytest.raises(ValueError, match="a sensor needs"):
        replace(CLEAN, **wrong)
