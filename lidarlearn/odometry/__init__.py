"""Odometries: an initialization and a registration backend, given one scan after the other.

Poses are float64 on the CPU, where six unknowns are solved fastest; points are float32 on the device of the odometry.
"""

from lidarlearn.odometry.backend import Backend
from lidarlearn.odometry.base import BaseOdometry, Frame
from lidarlearn.odometry.health import Health
from lidarlearn.odometry.initialization_only import InitializationOnly
from lidarlearn.odometry.judgement import Judgement
from lidarlearn.odometry.local_map import LocalMap
from lidarlearn.odometry.odometry import Odometry
from lidarlearn.odometry.sampling import GridSampling, ImageSampling

__all__ = [
    "Backend",
    "BaseOdometry",
    "Frame",
    "GridSampling",
    "Health",
    "ImageSampling",
    "InitializationOnly",
    "Judgement",
    "LocalMap",
    "Odometry",
]
