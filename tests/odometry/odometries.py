"""The odometries that users run, from the real configs, and short ways to feed them and to look at what they say."""

from collections.abc import Iterable
from functools import cache

import pytest
import torch
from hydra import compose, initialize_config_dir
from omegaconf import DictConfig
from torch import Tensor

from lidarlearn.commands.configs import config_directory
from lidarlearn.commands.evaluate import build_odometry, configured_method
from lidarlearn.geometry import se3
from lidarlearn.odometry.base import BaseOdometry, Frame
from lidarlearn.simulation.drive import Drive
from lidarlearn.simulation.sensors import Sensor, hdl32, hdl64, os1_64, vlp16
from tests import scenes

ASSOCIATIONS = ("kd", "vh", "p")
slow = pytest.mark.slow
kd_at_least = pytest.mark.parametrize("association", ["kd", *(pytest.param(a, marks=slow) for a in ("p", "vh"))])

FRAMES = 13
SMALL = hdl64(columns=512)
SENSORS = {"hdl64": hdl64(columns=1024), "hdl32": hdl32(), "vlp16": vlp16(), "os1_64": os1_64()}


def build(name: str, *overrides: str, projection: str = "hdl64") -> BaseOdometry:
    """A fresh odometry, e.g. "cv+kd_f2m", as `evaluate.py` builds it."""
    config = composed(f"projection@data.projection={projection}", *overrides)
    return build_odometry(config, configured_method(config, name))


@cache
def composed(*overrides: str) -> DictConfig:
    with initialize_config_dir(str(config_directory()), version_base="1.3"):
        return compose("evaluate", ["device=cpu", *overrides])


def run(odometry: BaseOdometry, scans: Iterable[Tensor]) -> list[Frame]:
    """One frame per scan."""
    return [odometry.register_scan(points) for points in scans]


def poses(frames: list[Frame]) -> Tensor:
    """`T_world_lidar` of all frames (n, 4, 4)."""
    return torch.stack([frame.T_world_lidar for frame in frames])


def motion_errors(estimated: Tensor, true: Tensor) -> tuple[Tensor, Tensor]:
    """Errors of the motions between consecutive poses: translations [m] and angles [deg]."""
    T_error = se3.inverse(se3.relative(true)) @ se3.relative(estimated)
    return T_error[:, :3, 3].norm(dim=1), se3.rotation_angle(T_error).rad2deg()


def scans_of(drive: Drive) -> list[Tensor]:
    """The points of all scans."""
    return [drive.scan(i).points for i in range(len(drive))]


@cache
def street(frames: int = FRAMES, step: float = 1.2, yaw_step: float = 0.0, sensor: Sensor = SMALL) -> Drive:
    """A drive at constant speed, `step` metres a scan, through a street where nothing moves."""
    path = scenes.straight_path(frames, step, yaw_step=yaw_step)
    return Drive(scenes.street(), poses=path, frames=frames, sensor=sensor)


@cache
def scans() -> tuple[Tensor, ...]:
    """The points of the scans of `street()`."""
    return tuple(scans_of(street()))
