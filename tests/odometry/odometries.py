"""Odometries built from the configs, short drives to feed them with, and their errors."""

from collections.abc import Iterable
from functools import cache

import pytest
import torch
from hydra import compose, initialize_config_dir
from omegaconf import DictConfig, OmegaConf
from torch import Tensor

from lidarlearn.commands.configs import config_directory
from lidarlearn.commands.evaluate import build_odometry, configured_method
from lidarlearn.data.sequence import Scan
from lidarlearn.geometry import se3
from lidarlearn.odometry.base import BaseOdometry, Frame
from lidarlearn.simulation.drive import Drive
from lidarlearn.simulation.sensors import Sensor, hdl32, hdl64, os1_64, vlp16
from tests import scenes

ASSOCIATIONS = ("kd", "vh", "p")
slow = pytest.mark.slow
kd_fast_others_slow = pytest.mark.parametrize(
    "association", ["kd", *(pytest.param(a, marks=slow) for a in ("p", "vh"))]
)

FRAMES = 10
SMALL = hdl64(columns=512)
SENSORS = {"hdl64": hdl64(columns=1024), "hdl32": hdl32(), "vlp16": vlp16(), "os1_64": os1_64()}


def build(name: str, *overrides: str, projection: str = "hdl64") -> BaseOdometry:
    """A fresh odometry, e.g. "cv+kd_f2m", as `evaluate.py` builds it."""
    config = configured(*overrides, projection=projection)
    return build_odometry(config, configured_method(config, name))


def configured(*overrides: str, projection: str = "hdl64") -> DictConfig:
    """The configuration of `evaluate.py`; values are set after composing, which is slow."""
    groups = [override for override in overrides if "@" in override]
    values = [override for override in overrides if "@" not in override]
    config = composed(f"projection@data.projection={projection}", *groups)
    return OmegaConf.merge(config, OmegaConf.from_dotlist(values))


@cache
def composed(*overrides: str) -> DictConfig:
    with initialize_config_dir(str(config_directory()), version_base="1.3"):
        return compose("evaluate", ["device=cpu", *overrides])


def run(odometry: BaseOdometry, scans: Iterable[Tensor]) -> list[Frame]:
    """One frame per scan."""
    return [odometry.register_scan(points) for points in scans]


def run_with_times(odometry: BaseOdometry, scans: Iterable[Scan]) -> list[Frame]:
    """One frame per scan, deskewed."""
    return [odometry.register_scan(scan.points, scan.times) for scan in scans]


def poses(frames: list[Frame]) -> Tensor:
    """`T_world_lidar` of all frames (n, 4, 4)."""
    return torch.stack([frame.T_world_lidar for frame in frames])


def motion_errors(estimated: Tensor, true: Tensor) -> tuple[Tensor, Tensor]:
    """Errors of the motions between consecutive poses: translations [m] and angles [deg]."""
    T_error = se3.inverse(se3.relative(true)) @ se3.relative(estimated)
    return T_error[:, :3, 3].norm(dim=1), se3.rotation_angle(T_error).rad2deg()


def yaw(angle_deg: float) -> Tensor:
    """A rotation about the vertical (4, 4)."""
    return se3.from_euler(torch.tensor([0, 0, 0, 0, 0, angle_deg], dtype=torch.float64).deg2rad())


def scans_of(drive: Drive) -> list[Tensor]:
    """The points of all scans."""
    return [scan.points for scan in drive]


@cache
def street(frames: int = FRAMES, step: float = 1.2, yaw_step: float = 0.0, sensor: Sensor = SMALL) -> Drive:
    """A drive at constant speed, `step` metres a scan, through a street where nothing moves."""
    path = scenes.straight_path(frames, step, yaw_step=yaw_step)
    return Drive(scenes.street(), poses=path, frames=frames, sensor=sensor)


@cache
def street_scans() -> tuple[Tensor, ...]:
    """The points of the scans of `street()`."""
    return tuple(scans_of(street()))


@cache
def street_frames(name: str) -> tuple[Frame, ...]:
    """The first frames of an odometry in `street()`, to compare with."""
    return tuple(run(build(name), street_scans()[:6]))


@cache
def distorted_street() -> Drive:
    """A drive like `street()`, with scans that are distorted by the motion."""
    path = scenes.straight_path(FRAMES + 4, 1.2)
    return Drive(scenes.street(), poses=path, frames=FRAMES + 1, sensor=SMALL, motion_distortion=True)


@cache
def distorted_scans() -> tuple[Scan, ...]:
    """The scans of `distorted_street()`."""
    return tuple(distorted_street())


@cache
def urban() -> Drive:
    """A drive at 10 m/s through a town where nothing moves."""
    return Drive("urban", seed=1, frames=6, speed=10.0, static=True, sensor=SENSORS["hdl64"])
