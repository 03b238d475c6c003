"""What holds for every association."""

import pytest
import torch
from torch import Tensor

from lidarlearn.geometry import se3
from lidarlearn.registration.association.base import Association, Correspondences
from tests.registration import maps


def assert_same(a: Correspondences, b: Correspondences) -> None:
    assert torch.equal(a.mask, b.mask)
    assert torch.equal(a.points[a.mask], b.points[a.mask]) and torch.equal(a.normals[a.mask], b.normals[a.mask])


@pytest.mark.parametrize("association", maps.ASSOCIATIONS)
@pytest.mark.parametrize("name", ["room", "street"])
def test_points_followed_find_what_a_new_search_finds(association, name):
    """Through steps like those of a registration, with a distance that narrows as there."""
    scene = maps.scene(name, association)
    T = scene.T_world_lidar @ se3.exp(torch.tensor([1.0, 0.5, 0.1, 0.02, -0.02, 0.1], dtype=torch.float64))
    scale = torch.tensor([1.0, 1.0, 1.0, 0.05, 0.05, 0.05], dtype=torch.float64)
    distance, found, matched = 2.0, None, 0
    generator = torch.Generator().manual_seed(0)
    for size in (0.3, 0.1, 0.05, 0.02, 0.01, 0.003, 0.001, 0.0, 0.05, 0.4):
        T = T @ se3.exp(size * scale * torch.randn(6, generator=generator, dtype=torch.float64))
        queries = se3.transform(T, scene.queries)
        found = scene.association.search(queries, distance, found.neighbours if found else None)
        assert_same(found, scene.association.search(queries, distance))
        matched += int(found.mask.sum())
        distance = max(0.7 * distance, 0.4)
    assert matched > len(queries)


@pytest.mark.parametrize("association", maps.ASSOCIATIONS)
def test_following_saves_looking_up(association, monkeypatch):
    scene = maps.scene("street", association)
    asked = []
    nearest = type(scene.association).nearest

    def counted(self: Association, points_world: Tensor, bins: Tensor, max_distance_m: float):
        asked.append(len(points_world))
        return nearest(self, points_world, bins, max_distance_m)

    monkeypatch.setattr(type(scene.association), "nearest", counted)
    queries = se3.transform(scene.T_world_lidar, scene.queries)
    found = scene.association.search(queries, 0.4)
    scene.association.search(queries + 0.005, 0.4, found.neighbours)
    assert asked[0] == len(queries) and asked[1] < 0.3 * len(queries)


@pytest.mark.parametrize("association", maps.ASSOCIATIONS)
def test_what_was_found_for_another_number_of_points_is_left_aside(association):
    scene = maps.scene("room", association)
    queries = se3.transform(scene.T_world_lidar, scene.queries)
    few = scene.association.search(queries[::4], 0.4)
    assert_same(scene.association.search(queries, 0.4, few.neighbours), scene.association.search(queries, 0.4))


@pytest.mark.parametrize("association", maps.ASSOCIATIONS)
def test_a_cleared_map_is_empty_and_finds_nothing(association):
    _, searchable = maps.make(association)
    assert searchable.is_empty
    searchable.insert(maps.drive("room").scan(0).points, se3.identity(), 30)
    assert not searchable.is_empty
    searchable.clear()
    assert searchable.is_empty
    assert not searchable.search(torch.randn(20, 3), 2.0).mask.any()


@pytest.mark.parametrize("association", maps.ASSOCIATIONS)
def test_an_empty_scan_adds_nothing_and_no_queries_find_nothing(association):
    _, searchable = maps.make(association)
    points = maps.drive("room").scan(0).points
    searchable.insert(points, se3.identity(), 30)
    queries = points[::50]
    before = searchable.search(queries, 0.5)
    searchable.insert(torch.zeros(0, 3), se3.identity(), 30)
    after = searchable.search(queries, 0.5)
    assert torch.equal(before.mask, after.mask) and torch.equal(before.points[before.mask], after.points[after.mask])
    assert searchable.search(torch.zeros(0, 3), 0.5).points.shape == (0, 3)


@pytest.mark.parametrize("association", maps.ASSOCIATIONS)
def test_neighbours_are_within_the_search_distance(association):
    scene = maps.scene("street", association)
    queries = se3.transform(scene.T_world_lidar, scene.queries)
    for distance in (0.1, 0.4, 1.0):
        found = scene.association.search(queries, distance)
        assert found.mask.any()
        assert (found.points - queries)[found.mask].norm(dim=1).max() <= distance + 1e-5
