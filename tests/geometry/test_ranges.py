import torch

from lidarlearn.geometry.ranges import in_range, squared_ranges


def test_squared_ranges():
    points = torch.tensor([[[3.0, 4.0, 0.0]], [[1.0, 2.0, 2.0]]])
    assert squared_ranges(points).tolist() == [[25.0], [9.0]]


def test_near_far_and_non_finite_points_are_out_of_range():
    nan, inf = float("nan"), float("inf")
    points = torch.tensor([[1.0, 0, 0], [3.0, 0, 0], [0, 100.0, 0], [0, 0, -101.0], [nan, 5, 5], [inf, 0, 0]])
    assert in_range(points, 2.5, 100.0).tolist() == [1, 2]
    assert in_range(points[:0], 2.5, 100.0).tolist() == []
