"""Presets of simulated worlds, and the static and moving things that are built for a drive."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from lidarlearn.errors import UserError
from lidarlearn.simulation import motions, objects
from lidarlearn.simulation.highway import furnish_highway
from lidarlearn.simulation.meshes import Mesh
from lidarlearn.simulation.motions import Driving
from lidarlearn.simulation.movers import Mover
from lidarlearn.simulation.sensors import Sensor, hdl32_inverted, hdl64
from lidarlearn.simulation.site import Profile, Site, Street
from lidarlearn.simulation.terrain import Terrain
from lidarlearn.simulation.trajectories import Vehicle, arc_length
from lidarlearn.simulation.urban import furnish_campus, furnish_town


@dataclass(frozen=True)
class World:
    """Everything that rays can hit.

    Args:
        static: everything that does not move, in the world frame.
        movers: everything that moves.
    """

    static: Mesh
    movers: tuple[Mover, ...] = ()


@dataclass(frozen=True)
class Preset:
    """A kind of place and the way of moving through it. Pairs are the least and greatest of random values.

    Args:
        driving: style of the drive; None for the run of a Segway.
        vehicle: the vehicle that carries the sensor.
        sensor: makes the usual sensor.
        slope_deg: slope of the terrain, see `Hills` [deg].
        half_width: half the width of the road of the drive [m].
        lane: distance of the drive to the right of the centreline of the road [m].
        profile: cross-section of the streets.
        side_streets: distance between crossings [m]; None for no crossings.
        furnish: builds the scenery.
        oncoming: distance between oncoming cars [m].
        traffic: speed of other cars [m/s].
        pedestrians: number of pedestrians.
    """

    driving: Driving | None
    vehicle: Vehicle
    sensor: Callable[[], Sensor]
    slope_deg: float
    half_width: float
    lane: float
    profile: Profile
    side_streets: tuple[float, float] | None
    furnish: Callable[[Site], None]
    oncoming: tuple[float, float]
    traffic: tuple[float, float]
    pedestrians: int


PRESETS = {
    "urban": Preset(
        driving=motions.URBAN,
        vehicle=Vehicle(),
        sensor=hdl64,
        slope_deg=1.8,
        half_width=4.0,
        lane=1.6,
        profile=Profile(kerb=0.12, bank=0.5, bank_start=14.0, roughness=0.02),
        side_streets=(45.0, 100.0),
        furnish=furnish_town,
        oncoming=(35.0, 120.0),
        traffic=(6.0, 13.0),
        pedestrians=12,
    ),
    "highway": Preset(
        driving=motions.HIGHWAY,
        vehicle=Vehicle(),
        sensor=hdl64,
        slope_deg=1.2,
        half_width=11.0,
        lane=5.5,
        profile=Profile(kerb=-0.25, bank=3.0, bank_start=3.0, roughness=0.05),
        side_streets=None,
        furnish=furnish_highway,
        oncoming=(30.0, 130.0),
        traffic=(20.0, 32.0),
        pedestrians=0,
    ),
    "campus": Preset(
        driving=motions.CAMPUS,
        vehicle=Vehicle(),
        sensor=hdl64,
        slope_deg=1.5,
        half_width=3.2,
        lane=1.3,
        profile=Profile(kerb=0.1, bank=1.0, bank_start=5.0, roughness=0.03),
        side_streets=(60.0, 130.0),
        furnish=furnish_campus,
        oncoming=(60.0, 200.0),
        traffic=(4.0, 9.0),
        pedestrians=25,
    ),
    "segway": Preset(
        driving=None,
        vehicle=Vehicle(0.96, sensor_forward=0.0, wheelbase=0.6, gauge=0.6, squat=0.05, lean=0.01),
        sensor=hdl32_inverted,
        slope_deg=1.5,
        half_width=1.6,
        lane=0.0,
        profile=Profile(kerb=0.02, bank=1.0, bank_start=5.0, roughness=0.03),
        side_streets=(15.0, 40.0),
        furnish=furnish_campus,
        oncoming=(1e9, 2e9),
        traffic=(1.0, 2.0),
        pedestrians=25,
    ),
}


def preset(name: str) -> Preset:
    """The preset of a name.

    Raises:
        UserError: there is no such preset.
    """
    if name not in PRESETS:
        raise UserError(f"there is no simulated world {name!r}; choose one of {', '.join(PRESETS)}")
    return PRESETS[name]


def build_world(
    place: Preset,
    rng: np.random.Generator,
    terrain: Terrain,
    track: Float[np.ndarray, "n 2"],
    ego: tuple[Float[np.ndarray, "k"], Float[np.ndarray, "k 2"]],
    static: bool,
) -> World:
    """Build the world along a path.

    Args:
        place: the kind of world.
        rng: random generator of everything random.
        terrain: the ground.
        track: the path of the drive, extended beyond either end; points about 1 m apart [m].
        ego: times [s] and positions [m] of the drive, so that cars ahead keep their distance.
        static: whether to leave out everything that moves.
    """
    main = Street(Street(track, place.half_width).offset(place.lane), place.half_width)
    streets = [main, *_side_streets(place, rng, main)]
    site = Site(rng, terrain, streets, place.profile)
    place.furnish(site)
    mesh = site.mesh()
    return World(mesh, () if static else tuple(_movers(place, site, track, ego)))


def _side_streets(place: Preset, rng: np.random.Generator, main: Street) -> list[Street]:
    """Streets that branch off: straight ahead at every turn, and to one side at random intervals."""
    if place.side_streets is None:
        return []
    along, left = main.frames()
    reach = np.arange(0.0, 80.0)[:, None]
    branches = []
    i = rng.uniform(*place.side_streets) / 2
    while i < len(left):
        k = int(i)
        tilt = rng.uniform(-0.2, 0.2)
        direction = rng.choice([-1.0, 1.0]) * (np.cos(tilt) * left[k] + np.sin(tilt) * along[k])
        branches.append(main.centreline[k] + reach * direction)
        i += rng.uniform(*place.side_streets)
    heading = np.unwrap(np.arctan2(along[:, 1], along[:, 0]))
    window = 25
    k = 0
    while k < len(heading) - window:
        if abs(heading[k + window] - heading[k]) > 0.9:
            branches.append(main.centreline[k] + reach * along[k])
            branches.append(main.centreline[k + window] - reach * along[k + window])
            k += window
        k += 1
    return [Street(branch, place.half_width * rng.uniform(0.75, 1.0)) for branch in branches]


def _movers(
    place: Preset, site: Site, track: Float[np.ndarray, "n 2"], ego: tuple[np.ndarray, np.ndarray]
) -> list[Mover]:
    rng, main = site.rng, site.streets[0]
    times, positions = ego
    driven = arc_length(positions)
    begin = float(np.argmin(np.linalg.norm(track - positions[0], axis=1)))
    movers = []
    if place.driving is not None:
        for gap in (rng.uniform(14, 35), rng.uniform(45, 80), -rng.uniform(12, 30)):
            if rng.random() < 0.7:
                drift = np.clip(rng.normal(scale=0.02) * driven, -8, 8)
                movers.append(Mover(_vehicle(rng), site.raised(track), times, begin + driven + gap + drift))
    lanes = [(main.offset(place.lane)[::-1], place.oncoming)]
    if main.half_width > 8:  # a wide road has a second lane in either direction
        lanes += [(main.offset(1.9)[::-1], place.oncoming), (main.offset(-1.9), place.oncoming)]
    for lane, spacing in lanes:
        line = site.raised(lane)
        speed, start = rng.uniform(*place.traffic), rng.uniform(0, spacing[0]) - 900.0
        while start < len(line):
            movers.append(Mover(_vehicle(rng), line, times, start + speed * (times - times[0])))
            start += rng.uniform(*spacing)
    for _ in range(place.pedestrians):
        side = rng.choice([-1, 1])
        line = site.raised(main.offset(side * (main.half_width + rng.uniform(0.8, 1.9)))[:: rng.choice([-1, 1])])
        travelled = rng.uniform(0, len(line)) + rng.uniform(0.8, 1.7) * (times - times[0])
        movers.append(Mover(objects.pedestrian(rng), line, times, travelled))
    return movers


def _vehicle(rng: np.random.Generator) -> Mesh:
    kind = int(rng.choice(3, p=[0.78, 0.12, 0.1]))
    return (objects.car, objects.van, objects.lorry)[kind](rng)
