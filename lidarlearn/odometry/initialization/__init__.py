"""Initial motion estimates: none, constant velocity, elevation image, PoseNet."""

from lidarlearn.odometry.initialization.base import Initialization, InitialMotion
from lidarlearn.odometry.initialization.constant_velocity import ConstantVelocity
from lidarlearn.odometry.initialization.elevation_image import ElevationImage
from lidarlearn.odometry.initialization.identity import NoInitialization

__all__ = ["ConstantVelocity", "ElevationImage", "InitialMotion", "Initialization", "NoInitialization"]
