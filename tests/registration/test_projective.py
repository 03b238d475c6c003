import pytest
import torch
from torch import Tensor

from lidarlearn.geometry import se3
from lidarlearn.geometry.normals import normal_map
from lidarlearn.geometry.projection import SphericalProjection
from lidarlearn.registration.association import Projective, point_buffer
from tests.registration import maps

SMALL = SphericalProjection(height=16, width=90, fov_up_deg=3.0, fov_down_deg=-24.0)


@pytest.fixture(scope="module")
def scans() -> list[Tensor]:
    return [maps.drive("street").scan(i).points for i in range(4)]


def poses() -> Tensor:
    return maps.drive("street").T_world_lidar


def slow_search(frames: list[tuple[Tensor, Tensor]], T_world_image: Tensor, queries: Tensor) -> list[Tensor | None]:
    """As in the paper: every frame is projected into one image; of a query's pixel, the closest in 3D.

    `frames` holds the points with normals of each scan, and its pose.
    """
    T_image_world, projected = se3.inverse(T_world_image), []
    for points, T_world in frames:
        local = se3.transform(T_image_world @ T_world, points)
        projected.append((SMALL.pixel_index(local), local.norm(dim=1), se3.transform(T_world, points)))
    found = []
    for query, pixel in zip(queries, SMALL.pixel_index(se3.transform(T_image_world, queries)), strict=True):
        in_pixel = [(ranges[pixels == pixel], world[pixels == pixel]) for pixels, ranges, world in projected]
        nearest = [world[ranges.argmin()] for ranges, world in in_pixel if pixel >= 0 and len(ranges)]
        found.append(min(nearest, key=lambda point: (point - query).norm().item(), default=None))
    return found


@pytest.mark.parametrize(
    ("image_distance_m", "inserted", "frames", "image"),
    [(0.0, 3, 30, 2), (0.0, 4, 2, 3), (100.0, 4, 2, 0)],
    ids=["new image for every scan", "oldest scans forgotten", "scans added to image nearby"],
)
def test_search_equals_that_of_paper(scans, image_distance_m, inserted, frames, image):
    association, kept = Projective(SMALL, image_distance_m=image_distance_m), []
    for i in range(inserted):
        association.insert(scans[i], poses()[i], frames)
        vertices = SMALL.vertex_map(scans[i])
        kept.append((vertices[:, (normal_map(vertices) != 0).any(dim=0)].T, poses()[i]))
    queries = se3.transform(poses()[3], scans[3][::97])
    found = association.search(queries, 2.0)
    agreeing = 0
    for i, expected in enumerate(slow_search(kept[-frames:], poses()[image], queries)):
        if expected is None or (expected - queries[i]).norm() > 2.0:
            agreeing += not found.mask[i]
        else:
            agreeing += bool(found.mask[i]) and torch.allclose(found.points[i], expected, atol=1e-4)
    assert found.mask.sum() > 100
    assert agreeing >= len(queries) - 2  # a point on the border of a pixel may round to either side


def test_scan_finds_its_own_points(scans):
    association = Projective(SphericalProjection())
    association.insert(scans[0], poses()[0], frames=30)
    vertices = association.projection.vertex_map(scans[0])
    own = vertices[:, (normal_map(vertices) != 0).any(dim=0)].T
    found = association.search(se3.transform(poses()[0], own), 0.5)
    assert found.mask.float().mean() > 0.999
    torch.testing.assert_close(found.points[found.mask], own[found.mask], rtol=0, atol=1e-4)
    assert (found.normals[found.mask].norm(dim=1) - 1).abs().max() < 1e-4


def test_window_forgets_oldest_scans(scans):
    window, alone = Projective(SMALL), Projective(SMALL)
    for i in range(4):
        window.insert(scans[i], poses()[i], frames=2)
    for i in (2, 3):
        alone.insert(scans[i], poses()[i], frames=2)
    queries = se3.transform(poses()[3], scans[3][::31])
    a, b = window.search(queries, 1.0), alone.search(queries, 1.0)
    assert torch.equal(a.mask, b.mask) and torch.equal(a.points[a.mask], b.points[b.mask])


def test_more_scans_find_closer_points(scans):
    few, many = Projective(SMALL), Projective(SMALL)
    for i in range(3):
        many.insert(scans[i], poses()[i], frames=30)
        few.insert(scans[i], poses()[i], frames=1)
    queries = se3.transform(poses()[3], scans[3][::31])
    a, b = few.search(queries, 1.0), many.search(queries, 1.0)
    assert b.mask.sum() > a.mask.sum()
    both = a.mask & b.mask
    closer = (b.points - queries)[both].norm(dim=1) <= (a.points - queries)[both].norm(dim=1) + 1e-5
    assert closer.all()


@pytest.mark.parametrize(
    ("xi", "starts"),
    [
        pytest.param((1.9, 0, 0, 0, 0, 0), False, id="near"),
        pytest.param((2.1, 0, 0, 0, 0, 0), True, id="far"),
        pytest.param((0, 0, 0, 0, 0.03, 0), True, id="tilted"),
        pytest.param((0, 0, 0, 0, 0, 2.0), False, id="turned"),
    ],
)
def test_distance_or_tilt_starts_new_image(scans, xi, starts):
    association = Projective(SMALL, image_distance_m=2.0)
    T_world_lidar = se3.exp(torch.tensor(xi, dtype=torch.float64))
    for T in (se3.identity(), se3.identity(), T_world_lidar):
        association.insert(scans[0], T, frames=2)
    ahead = torch.tensor([[10.0, 0.0, -1.0]])
    seen_from = T_world_lidar if starts else se3.identity()
    assert torch.equal(association.bins(se3.transform(seen_from, ahead)), SMALL.pixel_index(ahead))


def test_image_stays_valid_when_buffer_moves(scans, monkeypatch):
    queries, found = torch.cat([se3.transform(poses()[i], scans[i][::31]) for i in range(4)]), []
    for capacity in (1 << 16, 1):
        monkeypatch.setattr(point_buffer, "_INITIAL_CAPACITY", capacity)
        association = Projective(SMALL, image_distance_m=100.0)
        for i in range(4):
            association.insert(scans[i], poses()[i], frames=2)
            found.append(association.search(queries, 1.0))
    for a, b in zip(found[:4], found[4:], strict=True):
        assert a.mask.any() and torch.equal(a.mask, b.mask) and torch.equal(a.points[a.mask], b.points[b.mask])


def test_points_out_of_view_find_nothing(scans):
    association = Projective(SMALL)
    association.insert(scans[0], poses()[0], frames=30)
    overhead = torch.tensor([[0.0, 0.0, 5.0], [2.0, 0.0, 9.0], [0.0, 0.0, 0.0]])
    assert not association.search(overhead, 100.0).mask.any()


def test_normals_turn_with_scan(scans):
    T = se3.exp(torch.tensor([5.0, 1, 0, 0.2, -0.1, 1.0], dtype=torch.float64))
    straight, turned = Projective(SMALL), Projective(SMALL)
    straight.insert(scans[0], se3.identity(), frames=1)
    turned.insert(scans[0], T, frames=1)
    queries = scans[0][::53]
    a, b = straight.search(queries, 0.5), turned.search(se3.transform(T, queries), 0.5)
    both = a.mask & b.mask
    assert both.float().mean() > 0.3
    expected = a.normals @ T[:3, :3].float().T
    agreeing = ((expected - b.normals).norm(dim=1) < 1e-3)[both]
    assert agreeing.float().mean() > 0.99
