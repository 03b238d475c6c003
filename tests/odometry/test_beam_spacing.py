import pytest

from lidarlearn.geometry.projection import SphericalProjection
from lidarlearn.odometry.beam_spacing import map_voxel_m, query_voxel_m, search_distance_m


@pytest.mark.parametrize(("up", "down"), [(3.0, -24.0), (21.6, -21.6)])
def test_sensors_of_64_beams_use_grid_of_paper(up, down):
    projection = SphericalProjection(64, 720, up, down)
    assert (map_voxel_m(projection), query_voxel_m(projection), search_distance_m(projection)) == (0.4, 1.0, 0.5)


@pytest.mark.parametrize(("rows", "up", "down"), [(32, 11.3, -31.3), (16, 16.0, -16.0)])
def test_sensors_of_fewer_beams_use_wider_voxels(rows, up, down):
    projection = SphericalProjection(rows, 720, up, down)
    assert 0.4 < map_voxel_m(projection) <= query_voxel_m(projection) <= 1.2
    assert search_distance_m(projection) == map_voxel_m(projection)
