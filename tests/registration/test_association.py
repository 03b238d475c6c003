"""Properties that all associations share."""

import pytest
import torch
from torch import Tensor

from lidarlearn.geometry import se3
from lidarlearn.registration.association.base import Association, Correspondences
from tests.registration import maps

all_associations = pytest.mark.parametrize("association", maps.ASSOCIATIONS)


def assert_same(a: Correspondences, b: Correspondences) -> None:
    assert torch.equal(a.mask, b.mask)
    assert torch.equal(a.points[a.mask], b.points[a.mask]) and torch.equal(a.normals[a.mask], b.normals[a.mask])


@all_associations
@pytest.mark.parametrize("name", ["room", "street"])
def test_search_from_last_neighbours_equals_new_search(association, name):
    """Through steps like those of a registration, with a distance that narrows as there."""
    scene = maps.scene(name, association)
    T = scene.T_world_lidar @ se3.exp(torch.tensor([1.0, 0.5, 0.1, 0.02, -0.02, 0.1], dtype=torch.float64))
    scale = torch.tensor([1.0, 1.0, 1.0, 0.05, 0.05, 0.05], dtype=torch.float64)
    distance, found, matched = 2.0, None, 0
    generator = torch.Generator().manual_seed(0)
    for size in (0.3, 0.1, 0.05, 0.02, 0.01, 0.003, 0.001, 0.0, 0.05, 0.4):
        T = T @ se3.exp(size * scale * torch.randn(6, generator=generator, dtype=torch.float64))
        queries = se3.transform(T, scene.queries[::3])
        found = scene.association.search(queries, distance, found.neighbours if found else None)
        assert_same(found, scene.association.search(queries, distance))
        matched += int(found.mask.sum())
        distance = max(0.7 * distance, 0.4)
    assert matched > len(queries)


@all_associations
def test_search_from_last_neighbours_looks_up_few_points(association, monkeypatch):
    scene = maps.scene("street", association)
    looked_up = []
    nearest = type(scene.association).nearest

    def counted(self: Association, points_world: Tensor, bins: Tensor, max_distance_m: float):
        looked_up.append(len(points_world))
        return nearest(self, points_world, bins, max_distance_m)

    monkeypatch.setattr(type(scene.association), "nearest", counted)
    queries = se3.transform(scene.T_world_lidar, scene.queries)
    found = scene.association.search(queries, 0.4)
    scene.association.search(queries + 0.005, 0.4, found.neighbours)
    assert looked_up[0] == len(queries) and looked_up[1] < 0.3 * len(queries)


@all_associations
def test_last_neighbours_of_other_queries_are_ignored(association):
    scene = maps.scene("room", association)
    queries = se3.transform(scene.T_world_lidar, scene.queries)
    few = scene.association.search(queries[::4], 0.4)
    assert_same(scene.association.search(queries, 0.4, few.neighbours), scene.association.search(queries, 0.4))


@all_associations
def test_cleared_map_is_empty(association):
    _, searchable = maps.make(association)
    assert searchable.is_empty
    searchable.insert(maps.drive("room").scan(0).points, se3.identity(), 30)
    assert not searchable.is_empty
    searchable.clear()
    assert searchable.is_empty
    assert not searchable.search(torch.randn(20, 3), 2.0).mask.any()


@all_associations
def test_empty_scan_and_empty_queries_are_allowed(association):
    _, searchable = maps.make(association)
    points = maps.drive("room").scan(0).points
    searchable.insert(points, se3.identity(), 30)
    queries = points[::50]
    before = searchable.search(queries, 0.5)
    searchable.insert(torch.zeros(0, 3), se3.identity(), 30)
    after = searchable.search(queries, 0.5)
    assert torch.equal(before.mask, after.mask) and torch.equal(before.points[before.mask], after.points[after.mask])
    assert searchable.search(torch.zeros(0, 3), 0.5).points.shape == (0, 3)


@all_associations
def test_neighbours_are_within_the_search_distance(association):
    scene = maps.scene("street", association)
    queries = se3.transform(scene.T_world_lidar, scene.queries)
    for distance in (0.1, 0.4, 1.0):
        found = scene.association.search(queries, distance)
        assert found.mask.any()
        assert (found.points - queries)[found.mask].norm(dim=1).max() <= distance + 1e-5
