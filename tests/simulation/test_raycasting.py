import numpy as np
import pytest

from lidarlearn.simulation.meshes import box
from lidarlearn.simulation.raycasting import RayCaster


def _ray(origin, direction):
    return np.array([[*origin, *direction]], dtype=np.float32)


def test_rays_hit_box_at_exact_distance():
    caster = RayCaster(box(2.0, 4.0, 6.0))
    hits = caster.cast(np.concatenate([_ray((10, 0, 3), (-1, 0, 0)), _ray((0, 10, 3), (0, -1, 0))]))
    assert hits.distances == pytest.approx([9.0, 8.0])
    assert np.abs(hits.normals) == pytest.approx(np.array([[1.0, 0, 0], [0, 1, 0]]))


def test_rays_without_hit_have_infinite_distance():
    hits = RayCaster(box(1.0, 1.0, 1.0)).cast(_ray((0, 0, 5), (0, 0, 1)))
    assert np.isinf(hits.distances).all() and not hits.normals.any()
