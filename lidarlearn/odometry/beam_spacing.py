"""Voxel sizes and search distances that follow from the beam spacing of a sensor."""

import math

from lidarlearn.geometry.projection import SphericalProjection

_DENSE_MAP_VOXEL_M, _DENSE_QUERY_VOXEL_M = 0.4, 1.0
_MIN_SEARCH_DISTANCE_M = 0.5
_DENSE_RANGE_M = 35.0  # up to here neighbouring beams are no farther apart than a voxel


def map_voxel_m(projection: SphericalProjection) -> float:
    """Voxel edge for the map of a sensor [m]: the paper's 0.4 m for 64 beams, 0.8 m for 32, 1.2 m for 16.

    With 32 beams on a grid of 0.4 m, registration does not follow the pitching of a Segway.

    Args:
        projection: the sensor's image, one row per beam.

    Source: Dellenbach et al. 2021, IV-A, for the HDL-64.
    """
    beam_spacing = math.radians(projection.fov_up_deg - projection.fov_down_deg) / projection.height
    return max(_DENSE_MAP_VOXEL_M, round(beam_spacing * _DENSE_RANGE_M, 1))


def query_voxel_m(projection: SphericalProjection) -> float:
    """Voxel edge for the points that the paper's settings register [m]: 1 m for 64 beams; with fewer, that of the map.

    Args:
        projection: the sensor's image, one row per beam.
    """
    map_voxel = map_voxel_m(projection)
    return _DENSE_QUERY_VOXEL_M if map_voxel == _DENSE_MAP_VOXEL_M else map_voxel


def search_distance_m(projection: SphericalProjection) -> float:
    """Search distance for correspondences [m]: the edge of the map's voxels, but at least 0.5 m.

    With 32 beams, a search narrower than the voxels finds neighbours for only a fifth of a pitching Segway's points.

    Args:
        projection: the sensor's image, one row per beam.
    """
    return max(_MIN_SEARCH_DISTANCE_M, map_voxel_m(projection))
