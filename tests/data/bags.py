"""Point clouds in the layouts of drivers, and short ways to bags of them."""

import numpy as np

from lidarlearn.data.rosbag import Rosbag
from lidarlearn.geometry.projection import SphericalProjection
from tests.data.writers import as_rows, random_points

KINDS = ("ros1", "sqlite3", "mcap")
PLAIN = [("x", "<f4"), ("y", "<f4"), ("z", "<f4")]
# Ouster's layout: gaps between the fields and after the last one, times in nanoseconds
OUSTER = np.dtype(
    {
        "names": ["x", "y", "z", "intensity", "t", "reflectivity", "ring"],
        "formats": ["<f4", "<f4", "<f4", "<f4", "<u4", "<u2", "u1"],
        "offsets": [0, 4, 8, 16, 20, 24, 26],
        "itemsize": 48,
    }
)
TIMES_NS = np.linspace(0, 99_000_000, 200).astype(np.uint32)


def rosbag(root, **settings):
    return Rosbag(root, SphericalProjection(), **settings)


def plain_clouds(count=3, first=0):
    return [as_rows(random_points(first + i), PLAIN) for i in range(count)]


def first_x(sequence, index):
    return float(sequence.scan(index).points[0, 0])
