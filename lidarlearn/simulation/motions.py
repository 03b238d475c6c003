"""Motions of vehicles: cars in town, on a campus or on a motorway, and a Segway."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float
from scipy.interpolate import CubicSpline
from scipy.ndimage import gaussian_filter1d

from lidarlearn.simulation.trajectories import PlanarMotion, extended

_TIME_STEP = 0.05
_ARC_STEP = 0.5
_SCENERY_AHEAD = 120.0  # length of the world beyond either end of the drive [m]
_MAX_YAW_RATE = 0.68  # 39 deg/s; KITTI's cars turn by up to 40


@dataclass(frozen=True)
class Driving:
    """The style of a drive. Pairs are the least and greatest of values drawn at random along the road.

    Args:
        cruise: speed on a straight road [m/s].
        straight: length between two bends [m].
        turn_share: share of the bends that are turns into another road.
        turn_deg: angle of such a turn [deg].
        turn_radius: radius of such a turn [m].
        bend_deg: angle of any other bend [deg].
        bend_radius: radius of any other bend [m].
        acceleration: largest acceleration; brakes reach 1.3 times as much [m/s^2].
        lateral: largest lateral acceleration in bends [m/s^2].
        stretch: length of road with the same cruising speed [m].
        stop_share: share of the turns before which the car stops.
        sway_deg: standard deviation of the heading due to slow wandering within the lane [deg].
    """

    cruise: tuple[float, float]
    straight: tuple[float, float]
    turn_share: float
    turn_deg: tuple[float, float]
    turn_radius: tuple[float, float]
    bend_deg: tuple[float, float]
    bend_radius: tuple[float, float]
    acceleration: float = 1.6
    lateral: float = 3.2
    stretch: float = 60.0
    stop_share: float = 0.0
    sway_deg: float = 0.3


URBAN = Driving(
    cruise=(8.0, 15.0),
    straight=(20.0, 70.0),
    turn_share=0.5,
    turn_deg=(70.0, 105.0),
    turn_radius=(8.0, 16.0),
    bend_deg=(5.0, 40.0),
    bend_radius=(30.0, 120.0),
    stop_share=0.15,
)
CAMPUS = Driving(
    cruise=(4.5, 9.0),
    straight=(25.0, 80.0),
    turn_share=0.4,
    turn_deg=(50.0, 100.0),
    turn_radius=(8.0, 18.0),
    bend_deg=(10.0, 50.0),
    bend_radius=(20.0, 80.0),
    stop_share=0.2,
)
HIGHWAY = Driving(
    cruise=(18.5, 30.5),
    straight=(60.0, 250.0),
    turn_share=0.0,
    turn_deg=(0.0, 0.0),
    turn_radius=(100.0, 100.0),
    bend_deg=(3.0, 25.0),
    bend_radius=(250.0, 900.0),
    acceleration=0.9,
    stretch=220.0,
    sway_deg=0.15,
)


def drive(
    rng: np.random.Generator, driving: Driving, start: float, duration: float, speed: float | None = None
) -> PlanarMotion:
    """The drive of a car, which moves from the first instant on.

    Args:
        rng: random generator of the route and the speeds.
        driving: the style of the drive.
        start: first time [s].
        duration: duration of the drive [s].
        speed: constant speed, for which turns are widened as needed [m/s]; None varies it with the road and the style.
    """
    times = start + _TIME_STEP * np.arange(int(np.ceil(duration / _TIME_STEP)) + 1)
    reach = duration * (driving.cruise[1] if speed is None else speed) + _SCENERY_AHEAD + 10
    curvature, limit, stops = _route(rng, driving, _SCENERY_AHEAD, reach, speed)
    heading = np.cumsum(curvature) * _ARC_STEP
    direction = np.stack([np.cos(heading), np.sin(heading)], axis=-1)
    xy = np.cumsum(np.concatenate([np.zeros((1, 2)), (direction[:-1] + direction[1:]) / 2 * _ARC_STEP]), axis=0)
    s = _ARC_STEP * np.arange(len(xy)) - _SCENERY_AHEAD
    if speed is None:
        along, pace = _speed_over_time(times - start, s, _drivable(limit, driving), stops)
    else:
        along, pace = speed * (times - start), np.full(len(times), speed)
    position = np.stack([_smooth_interp(along, s, xy[:, k]) for k in (0, 1)], axis=-1)
    end = np.searchsorted(s, along[-1] + _SCENERY_AHEAD)
    facing = _smooth_interp(along, s, heading)
    return PlanarMotion(times, position, facing, pace, np.zeros(len(times)), xy[:end:2])


def _route(
    rng: np.random.Generator, driving: Driving, before: float, reach: float, speed: float | None
) -> tuple[Float[np.ndarray, "n"], Float[np.ndarray, "n"], list[tuple[float, float]]]:
    """Curvature [1/m] and speed limit [m/s] along a route, and stops as (place [m], duration [s]); 0 is the start."""
    smallest = 0.0 if speed is None else max(speed**2 / driving.lateral, speed / (0.8 * _MAX_YAW_RATE))
    curvature = [np.zeros(int(before / _ARC_STEP))]
    stops: list[tuple[float, float]] = []
    place, turned = rng.uniform(*driving.straight) * rng.uniform(0.2, 1), 0.0
    curvature.append(np.zeros(int(place / _ARC_STEP)))
    while place < reach:
        turn = rng.random() < driving.turn_share
        angle = np.radians(rng.uniform(*(driving.turn_deg if turn else driving.bend_deg)))
        # Turn back before turning too far: a route that keeps its general direction does not cross itself.
        sign = -np.sign(turned) if abs(turned) > 0.8 else rng.choice([-1.0, 1.0])
        radius = max(rng.uniform(*(driving.turn_radius if turn else driving.bend_radius)), smallest)
        if turn and rng.random() < driving.stop_share:
            stops.append((place - 6.0, rng.uniform(0.5, 2.0)))
        count, straight = max(1, round(angle * radius / _ARC_STEP)), rng.uniform(*driving.straight)
        curvature += [np.full(count, sign * angle / (count * _ARC_STEP)), np.zeros(int(straight / _ARC_STEP))]
        turned += sign * angle
        place += count * _ARC_STEP + straight
    profile = gaussian_filter1d(np.concatenate(curvature), 3.0 / _ARC_STEP, mode="nearest")
    wander = gaussian_filter1d(rng.normal(size=len(profile)), 15.0 / _ARC_STEP, mode="nearest")
    wander = np.gradient(np.radians(driving.sway_deg) * wander / wander.std(), _ARC_STEP)
    stretch = int(driving.stretch / _ARC_STEP)
    cruise = np.repeat(rng.uniform(*driving.cruise, len(profile) // stretch + 1), stretch)[: len(profile)]
    bend = np.abs(profile) + 1e-9
    limit = np.minimum(cruise, np.minimum(np.sqrt(driving.lateral / bend), _MAX_YAW_RATE / bend))
    return profile + wander, limit, stops


def _drivable(limit: Float[np.ndarray, "n"], driving: Driving) -> Float[np.ndarray, "n"]:
    """The highest speed below `limit` that the acceleration and the brakes of the car allow."""
    speed = limit.copy()
    for i in range(1, len(speed)):
        speed[i] = min(speed[i], np.sqrt(speed[i - 1] ** 2 + 2 * driving.acceleration * _ARC_STEP))
    for i in range(len(speed) - 2, -1, -1):
        speed[i] = min(speed[i], np.sqrt(speed[i + 1] ** 2 + 2 * 1.3 * driving.acceleration * _ARC_STEP))
    return speed


def _speed_over_time(
    times: Float[np.ndarray, "n"],
    s: Float[np.ndarray, "m"],
    speed: Float[np.ndarray, "k"],
    stops: list[tuple[float, float]],
) -> tuple[Float[np.ndarray, "n"], Float[np.ndarray, "n"]]:
    """Distance covered [m] and speed [m/s] at `times`, from speeds along the route and stops, without jerks."""
    nodes = s[: len(speed)]
    for place, _ in stops:
        if place > 25:  # the drive starts in motion
            speed = np.minimum(speed, np.sqrt(3.2 * np.abs(nodes - place) + 0.04))
    clock = np.concatenate([[0], np.cumsum(_ARC_STEP / ((speed[1:] + speed[:-1]) / 2))])
    for place, dwell in stops:
        clock = clock + dwell * (nodes > place) * (place > 25)
    clock = clock - np.interp(0.0, nodes, clock)
    padding = 40  # so that smoothing has values beyond either end
    fine = np.concatenate([times[0] + _TIME_STEP * np.arange(-padding, 0), times])
    fine = np.concatenate([fine, times[-1] + _TIME_STEP * np.arange(1, padding + 1)])
    pace = np.gradient(np.interp(fine, clock, nodes), _TIME_STEP)
    pace = gaussian_filter1d(pace, 0.35 / _TIME_STEP)[padding:-padding]
    along = np.concatenate([[0], np.cumsum((pace[1:] + pace[:-1]) / 2 * _TIME_STEP)])
    return along, pace


def _smooth_interp(
    x: Float[np.ndarray, "n"], nodes: Float[np.ndarray, "m"], values: Float[np.ndarray, "k"]
) -> Float[np.ndarray, "n"]:
    """Cubic interpolation: a piecewise linear path would jerk at every node."""
    count = min(len(nodes), len(values))
    return CubicSpline(nodes[:count], values[:count])(x)


def segway(rng: np.random.Generator, start: float, duration: float, speed: float | None = None) -> PlanarMotion:
    """The run of a Segway: at most 1.5 m/s, with abrupt yaw and a pitch that swings by several degrees as it balances.

    Args:
        rng: random generator of the run.
        start: first time [s].
        duration: duration of the run [s].
        speed: constant speed [m/s]; None varies it.
    """
    times = start + _TIME_STEP * np.arange(int(np.ceil(duration / _TIME_STEP)) + 1)
    pace = _held(rng, times, (2.0, 6.0), lambda: rng.choice([0.0, rng.uniform(0.4, 1.5)], p=[0.15, 0.85]), 0.4)
    if speed is not None:
        pace = np.full(len(times), speed)
    turning = _held(rng, times, (1.0, 4.0), lambda: rng.normal(scale=0.12), 0.25)
    jerks = np.zeros(len(times))
    for moment in np.arange(start + rng.uniform(0, 2), times[-1], 2.5):
        angle, width = rng.choice([-1.0, 1.0]) * np.radians(rng.uniform(10, 60)), rng.uniform(0.12, 0.3)
        centre = moment + rng.uniform(-0.8, 0.8)
        jerks += angle * np.exp(-0.5 * ((times - centre) / width) ** 2) / (width * np.sqrt(2 * np.pi))
    heading = np.cumsum(turning + jerks) * _TIME_STEP
    heading -= 0.6 * (heading - gaussian_filter1d(heading, 8 / _TIME_STEP))  # keeps a general direction
    velocity = pace[:, None] * np.stack([np.cos(heading), np.sin(heading)], axis=-1)
    xy = np.concatenate([np.zeros((1, 2)), np.cumsum((velocity[1:] + velocity[:-1]) / 2 * _TIME_STEP, axis=0)])
    sway = gaussian_filter1d(rng.normal(size=len(times) + 80), 0.22 / _TIME_STEP)[40:-40]
    swing = np.radians(2.2) * sway / max(sway.std(), 1e-9)
    return PlanarMotion(times, xy, heading, pace, swing, extended(xy, 60.0))


def _held(
    rng: np.random.Generator,
    times: Float[np.ndarray, "n"],
    hold: tuple[float, float],
    draw: Callable[[], float],
    width: float,
) -> Float[np.ndarray, "n"]:
    """Values drawn one after another, each held for a time within `hold` [s]; changes are smoothed over `width` [s]."""
    values = np.empty(len(times))
    filled = 0
    while filled < len(values):
        count = max(1, round(rng.uniform(*hold) / _TIME_STEP))
        values[filled : filled + count] = draw()
        filled += count
    return gaussian_filter1d(values, width / _TIME_STEP, mode="nearest")
