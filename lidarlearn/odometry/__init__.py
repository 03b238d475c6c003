"""Odometries: an initialization and a registration backend, fed scan by scan.

Poses are float64 on the CPU, where six unknowns are solved fastest; points are float32 on the device of the odometry.
"""

from lidarlearn.odometry.backend import Backend
from lidarlearn.odometry.health import Health
from lidarlearn.odometry.judgement import Judgement
from lidarlearn.odometry.local_map import LocalMap
from lidarlearn.odometry.odometry import Odometry
from lidarlearn.odometry.sampling import GridSampling, ImageSampling
from lidarlearn.odometry.scan_by_scan import Frame, InitializationAlone, ScanByScan

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
