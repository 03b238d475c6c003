"""Odometries: an initialization and a registration backend, fed scan by scan."""

from lidarlearn.odometry.backend import Backend
from lidarlearn.odometry.health import Health
from lidarlearn.odometry.local_map import LocalMap
from lidarlearn.odometry.odometry import Frame, InitializationAlone, Judgement, Odometry, ScanByScan
from lidarlearn.odometry.sampling import GridSampling, ImageSampling

__all__ = [
    "Backend",
    "Frame",
    "GridSampling",
    "Health",
    "ImageSampling",
    "InitializationAlone",
    "Judgement",
    "LocalMap",
    "Odometry",
    "ScanByScan",
]
