import math

import pytest
import torch

from lidarlearn.data.beam_correction import raise_beams
from lidarlearn.geometry import se3
from tests.data.writers import random_points


def elevation(points):
    return torch.atan2(points[:, 2], points[:, :2].norm(dim=1))


@pytest.mark.parametrize("angle_deg", [0.205, -0.5, 3.0])
def test_raise_beams_changes_elevation_only(angle_deg):
    points = torch.from_numpy(random_points(0)).double()
    raised = raise_beams(points, angle_deg)
    assert torch.allclose(elevation(raised) - elevation(points), torch.tensor(math.radians(angle_deg)).double())
    assert torch.allclose(raised.norm(dim=1), points.norm(dim=1))
    assert torch.allclose(torch.atan2(raised[:, 1], raised[:, 0]), torch.atan2(points[:, 1], points[:, 0]))


def test_raise_beams_rotates_about_p_cross_z():
    points = torch.from_numpy(random_points(1)).double()
    axis = torch.linalg.cross(points, torch.tensor([[0.0, 0.0, 1.0]]).double().expand_as(points))
    phi = math.radians(0.205) * axis / axis.norm(dim=1, keepdim=True)
    T = se3.exp(torch.cat([torch.zeros_like(phi), phi], dim=1))
    assert torch.allclose(raise_beams(points, 0.205), (T[:, :3, :3] @ points[:, :, None])[..., 0])


def test_points_on_axis_and_zero_angle_are_unchanged():
    axis = torch.tensor([[0.0, 0.0, 0.0], [0.0, 0.0, 3.0], [0.0, 0.0, -2.0]])
    assert torch.equal(raise_beams(axis, 0.205), axis)
    points = torch.from_numpy(random_points(2))
    assert torch.equal(raise_beams(points, 0.0), points)
