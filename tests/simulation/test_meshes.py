import numpy as np
import pytest

from lidarlearn.simulation import objects
from lidarlearn.simulation.buildings import building, hall
from lidarlearn.simulation.meshes import box, cylinder, empty, extruded, instances, merge, sheet


def _volume(mesh):
    a, b, c = (mesh.vertices[mesh.triangles[:, k]] for k in range(3))
    return np.einsum("ij,ij->i", a, np.cross(b, c)).sum() / 6


def test_box_volume():
    assert _volume(box(2.0, 3.0, 4.0, base=1.0)) == pytest.approx(24.0)


def test_cylinder_volume_is_that_of_prism():
    assert _volume(cylinder(2.0, 3.0, sides=6)) == pytest.approx(3.0 * 6 * 0.5 * 4 * np.sin(np.pi / 3))


def test_extruded_square_is_a_box():
    outline = np.array([[-1.0, 0], [-1, 2], [1, 2], [1, 0]])
    assert abs(_volume(extruded(outline, 3.0))) == pytest.approx(12.0)


def test_moved_rotates_about_z_then_shifts():
    mesh = box(2.0, 1.0, 1.0).moved(x=10.0, yaw=np.pi / 2)
    assert np.ptp(mesh.vertices, axis=0) == pytest.approx([1.0, 2.0, 1.0])
    assert mesh.vertices.mean(axis=0) == pytest.approx([10.0, 0, 0.5])


def test_merge_keeps_all_triangles():
    a, b = box(1.0, 1.0, 1.0), box(1.0, 1.0, 1.0).moved(x=5.0)
    merged = merge([a, empty(), b])
    assert _volume(merged) == pytest.approx(2.0)
    assert np.array_equal(merged.vertices[merged.triangles[12:]], b.vertices[b.triangles])


def test_instances_scale_each_copy():
    copies = instances(box(1.0, 1.0, 1.0), np.zeros((2, 3)), np.zeros(2), np.array([[1.0, 1, 1], [2, 2, 2]]))
    assert _volume(copies) == pytest.approx(9.0)


def test_sheet_omits_masked_cells():
    points = np.stack(np.meshgrid(np.arange(3.0), np.arange(3.0), [0.0], indexing="ij"), axis=-1)[:, :, 0]
    keep = np.array([[True, False], [False, False]])
    assert len(sheet(points, keep).triangles) == 2
    assert sheet(points, keep).vertices.max() == 1.0


@pytest.mark.parametrize(
    "parameters",
    [
        (objects.car,),
        (objects.van,),
        (objects.lorry,),
        (objects.pedestrian,),
        (objects.tree,),
        (objects.conifer,),
        (objects.bush,),
        (objects.lamp,),
        (objects.sign,),
        (objects.road_sign,),
        (objects.bench,),
        (objects.bollard,),
        (objects.bin_or_box,),
        (objects.wall, 6.0),
        (objects.fence, 6.0),
        (objects.hedge, 6.0),
        (objects.gantry, 15.0),
        (building, 12.0, 9.0, 8.0),
        (hall, 20.0, 12.0, 6.0),
    ],
    ids=lambda parameters: parameters[0].__name__,
)
def test_objects_have_plausible_size_and_touch_ground(parameters):
    make, *size = parameters
    mesh = make(np.random.default_rng(0), *size)
    assert np.isfinite(mesh.vertices).all()
    assert 0 <= mesh.triangles.min() and mesh.triangles.max() < len(mesh.vertices)
    assert mesh.vertices[:, 2].min() < 0.6
    assert 0.5 < mesh.vertices[:, 2].max() < 20
    assert np.ptp(mesh.vertices[:, :2], axis=0).max() < 30
