"""A simulated drive, whose scans are made in memory from a few settings."""

import hashlib
from collections.abc import Iterator
from dataclasses import asdict
from functools import cached_property
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Bool, Float, Float32, UInt16

from lidarlearn.data.pose_files import start_at_identity
from lidarlearn.data.sequence import Scan, Sequence
from lidarlearn.simulation import motions
from lidarlearn.simulation.meshes import merge
from lidarlearn.simulation.movers import snapshot
from lidarlearn.simulation.raycasting import RayCaster
from lidarlearn.simulation.sensors import Sensor
from lidarlearn.simulation.terrain import GroundBelow, Hills, Terrain
from lidarlearn.simulation.trajectories import Trajectory, extended, on_ground
from lidarlearn.simulation.worlds import World, build_world, preset
from lidarlearn.source_digest import source_digest

_SIMULATOR = Path(__file__).resolve().parent

# Each source of randomness has its own stream, so that e.g. a drive takes the same route with and without traffic.
_TERRAIN, _MOTION, _WORLD, _SCAN = range(4)


class Drive(Sequence):
    """A drive through a simulated world. Scans are made on request; each depends on the settings alone.

    Args:
        world: "urban", "highway", "campus", "segway", or an existing world, which needs `poses`.
        seed: seed of everything random; the same seed gives the same bytes.
        frames: number of scans.
        sensor: the sensor; None takes the usual one of the world.
        speed: constant speed [m/s]; None varies it as is usual in the world.
        static: leave out everything that moves.
        motion_distortion: cast every column from its own pose, and give scans the times of their points.
        poses: path of the sensor, `T_world_lidar` once per scan [m], around which the scenery is built; None makes one.
        name: name of the sequence; None takes that of the world and the seed.
    """

    def __init__(
        self,
        world: str | World = "urban",
        seed: int = 0,
        frames: int = 100,
        sensor: Sensor | None = None,
        speed: float | None = None,
        static: bool = False,
        motion_distortion: bool = False,
        poses: Float[np.ndarray, "n 4 4"] | None = None,
        name: str | None = None,
    ) -> None:
        if frames < 1:
            raise ValueError(f"a drive needs at least one frame, got {frames}")
        if isinstance(world, World) and poses is None:
            raise ValueError("a world of your own needs poses: Drive(world, poses=...)")
        self.seed, self.static, self.motion_distortion, self.speed = seed, static, motion_distortion, speed
        self._preset = preset("urban" if isinstance(world, World) else world)
        self.world_name = "custom" if isinstance(world, World) else world
        self.sensor = self._preset.sensor() if sensor is None else sensor
        self.frames = frames if poses is None else min(frames, len(poses))
        self.name = f"{self.world_name}_{seed:02d}" if name is None else name
        # The scenery continues beyond the last scan, but not along all of a long file.
        self._given_poses = None if poses is None else np.asarray(poses[: frames + 100], dtype=np.float64)
        self._given_world = world if isinstance(world, World) else None
        self.timestamps = torch.arange(self.frames, dtype=torch.float64) * self.sensor.period
        self.T_world_lidar = start_at_identity(torch.from_numpy(self.trajectory.at(self.timestamps.numpy())))

    def __len__(self) -> int:
        return self.frames

    @property
    def fingerprint(self) -> str:
        """Hash of the settings and of the simulator's code, since other code may make other scans."""
        settings = [simulator_digest(), self.world_name, self.seed, self.frames, sorted(asdict(self.sensor).items())]
        settings += [self.speed, self.static, self.motion_distortion]
        digest = hashlib.sha256(repr(settings).encode())
        if self._given_poses is not None:
            digest.update(self._given_poses.tobytes())
        if self._given_world is not None:
            for array in _arrays(self._given_world):
                digest.update(repr((array.shape, array.dtype)).encode() + array.tobytes())
        return digest.hexdigest()[:16]

    def __getstate__(self) -> dict[str, object]:
        """The state without Open3D's scene and the world, which are rebuilt on demand."""
        return {key: value for key, value in self.__dict__.items() if key not in ("_caster", "world")}

    def build(self) -> None:
        """Build the world now instead of with the first scan. From then on, several threads may make scans."""
        self._caster.cast(np.ones((1, 6), dtype=np.float32))  # Open3D completes a scene with the first cast

    def scan(self, index: int) -> Scan:
        """Simulate one scan; it has times if it is distorted by motion."""
        points, times = self.sensor.points(self.ranges(index), index)
        return Scan(torch.from_numpy(points), torch.from_numpy(times) if self.motion_distortion else None)

    def ranges(self, index: int) -> UInt16[np.ndarray, "beams columns"]:
        """The range image that the sensor reports for one scan, in steps of `sensors.RANGE_STEP`."""
        if not 0 <= index < self.frames:
            raise IndexError(f"{self.name} has scans 0 to {self.frames - 1}, asked for {index}")
        distances, cos_incidence = self._cast(index)
        return self.sensor.measure(distances, cos_incidence, self._rng(_SCAN, index))

    @cached_property
    def trajectory(self) -> Trajectory:
        """The sensor's trajectory in the map frame, in which the world is built."""
        return self._motion[0]

    @cached_property
    def world(self) -> World:
        """Everything that rays can hit, in the map frame."""
        if self._given_world is not None:
            return self._given_world
        trajectory, terrain, track = self._motion
        ego = trajectory.times, trajectory.poses[:, :2, 3]
        return build_world(self._preset, self._rng(_WORLD), terrain, track, ego, self.static)

    @cached_property
    def _motion(self) -> tuple[Trajectory, Terrain, np.ndarray]:
        period = self.sensor.period
        if self._given_poses is not None:
            times = period * np.arange(len(self._given_poses))
            feet = self._given_poses[:, :3, 3] - self._preset.vehicle.sensor_height * self._given_poses[:, :3, 2]
            track = extended(feet, 100.0)
            return Trajectory(times, self._given_poses), GroundBelow(track), track[:, :2]
        terrain = Hills(self._rng(_TERRAIN), self._preset.slope_deg)
        rng, start, duration = self._rng(_MOTION), -2 * period, (self.frames + 3) * period
        if self._preset.driving is None:
            motion = motions.segway(rng, start, duration, self.speed)
        else:
            motion = motions.drive(rng, self._preset.driving, start, duration, self.speed)
        return on_ground(motion, terrain, self._preset.vehicle), terrain, motion.track

    @cached_property
    def _caster(self) -> RayCaster:
        return RayCaster(self.world.static)

    def _rng(self, *stream: int) -> np.random.Generator:
        return np.random.default_rng([self.seed, *stream])

    def _cast(self, index: int) -> tuple[Float[np.ndarray, "beams columns"], Float[np.ndarray, "beams columns"]]:
        """True distances [m] and cosines of the angles of incidence of one scan."""
        sensor, period = self.sensor, self.sensor.period
        shares = sensor.column_times() if self.motion_distortion else np.zeros(1)
        T_map_column = self.trajectory.at((index + shares) * period)
        rays = np.empty((sensor.beams, sensor.columns, 6), dtype=np.float32)
        rays[..., :3] = T_map_column[:, :3, 3]
        rays[..., 3:] = sensor.directions(index, T_map_column[:, :3, :3])
        distances, cosines = _first_hits(self._caster, rays)
        if self.world.movers:
            self._cast_movers(index, rays, distances, cosines)
        return distances, cosines

    def _cast_movers(self, index: int, rays: np.ndarray, distances: np.ndarray, cosines: np.ndarray) -> None:
        """Add moving things in front of static ones, in place. Only columns that may see them are cast again."""
        sensor = self.sensor
        sectors = 12 if self.motion_distortion else 1
        for sector in np.array_split(np.arange(sensor.columns), sectors):
            share = sensor.column_times()[sector].mean() if self.motion_distortion else 0.0
            time = (index + share) * sensor.period
            pose = self.trajectory.at(np.array([time]))[0]
            meshes = snapshot(self.world.movers, time, pose[:3, 3], sensor.max_range)
            if not meshes:
                continue
            azimuths = sensor.azimuths(index)[sector]
            columns = sector[np.any([_seen(mesh.vertices, pose, azimuths) for mesh in meshes], axis=0)]
            if len(columns):
                part = np.ascontiguousarray(rays[:, columns])
                found, cosine = _first_hits(RayCaster(merge(meshes)), part)
                nearer = found < distances[:, columns]
                distances[:, columns] = np.where(nearer, found, distances[:, columns])
                cosines[:, columns] = np.where(nearer, cosine, cosines[:, columns])


def simulator_digest() -> str:
    """Hash of the code on which scans depend: this module and the modules of the simulator that it uses."""
    return source_digest(Path(__file__), within=_SIMULATOR)


def _first_hits(
    caster: RayCaster, rays: Float32[np.ndarray, "beams columns 6"]
) -> tuple[Float[np.ndarray, "beams columns"], Float[np.ndarray, "beams columns"]]:
    """Distances [m] to what rays hit, and cosines of the angles of incidence."""
    hits = caster.cast(rays)
    return hits.distances, np.abs(np.einsum("bck,bck->bc", hits.normals, rays[..., 3:]))


def _arrays(world: World) -> Iterator[np.ndarray]:
    """All arrays of a world."""
    for mesh in (world.static, *(mover.mesh for mover in world.movers)):
        yield from (mesh.vertices, mesh.triangles)
    for mover in world.movers:
        yield from (mover.lane, mover.times, mover.travelled)


def _seen(
    vertices: Float[np.ndarray, "n 3"], pose: Float[np.ndarray, "4 4"], azimuths: Float[np.ndarray, "columns"]
) -> Bool[np.ndarray, "columns"]:
    """Which azimuths may hit a body: those between its least and greatest bearing, or all if the sensor is inside.

    Bearings get a margin of 4 degrees, or of 30 degrees within 6 m, because each column is cast from its own pose.
    """
    xy = ((vertices - pose[:3, 3]) @ pose[:3, :3])[:, :2]
    middle = np.arctan2(*xy.mean(axis=0)[::-1])  # towards the inside of the body; bearings are relative to it
    bearings = (np.arctan2(xy[:, 1], xy[:, 0]) - middle + np.pi) % (2 * np.pi) - np.pi
    if np.ptp(bearings) >= np.pi:
        return np.ones(len(azimuths), dtype=bool)
    spare = np.radians(np.where(np.hypot(xy[:, 0], xy[:, 1]) < 6.0, 30.0, 4.0))
    low, high = (bearings - spare).min(), (bearings + spare).max()
    return (azimuths - middle - low) % (2 * np.pi) <= high - low
