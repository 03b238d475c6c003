"""The backends of `configs/odometry/` for a sensor, without Hydra.

With a size of 1 the map is the previous scan: frame-to-frame.
"""

import torch

from lidarlearn.geometry.projection import SphericalProjection
from lidarlearn.odometry.backend import Backend
from lidarlearn.odometry.beam_spacing import map_voxel_m, search_distance_m
from lidarlearn.odometry.local_map import LocalMap
from lidarlearn.odometry.sampling import GridSampling, ImageSampling
from lidarlearn.registration.association import KdTree, Projective, VoxelHash
from lidarlearn.registration.gauss_newton import GaussNewton


def kd_f2m(projection: SphericalProjection, size: int = 30, device: torch.device | str = "cpu") -> Backend:
    """Kd-F2M: the nearest point of the last scans, aggregated on a grid, by a KdTree.

    Args:
        projection: the sensor's image, one row per beam.
        size: number of scans in the map.
        device: where the map is kept.
    """
    return _on_a_grid(KdTree(map_voxel_m(projection), device), projection, size)


def vh_f2m(projection: SphericalProjection, size: int = 30, device: torch.device | str = "cpu") -> Backend:
    """VH-F2M: the same, but searched through the hash table of the voxel map.

    Args:
        projection: the sensor's image, one row per beam.
        size: number of scans in the map.
        device: where the map is kept and searched.
    """
    return _on_a_grid(VoxelHash(map_voxel_m(projection), device), projection, size)


def p_f2m(projection: SphericalProjection, size: int = 30, device: torch.device | str = "cpu") -> Backend:
    """P-F2M: the closest in 3D among the map points of the same pixel.

    Args:
        projection: the sensor's image.
        size: number of scans in the map.
        device: where the map is kept and searched.
    """
    return Backend(ImageSampling(projection), LocalMap(Projective(projection, device, image_distance_m=2.0), size))


def _on_a_grid(association: KdTree | VoxelHash, projection: SphericalProjection, size: int) -> Backend:
    return Backend(
        GridSampling(map_voxel_m(projection)),
        LocalMap(association, size),
        GaussNewton(search_distance_m=search_distance_m(projection)),
    )
