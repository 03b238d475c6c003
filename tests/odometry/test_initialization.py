import math

import pytest
import torch
from torch import Tensor

from lidarlearn.geometry import se3
from lidarlearn.geometry.projection import SphericalProjection
from lidarlearn.odometry.initialization import ConstantVelocity, ElevationImage, InitialMotion, NoInitialization
from lidarlearn.odometry.initialization.posenet import PoseNetInitialization
from tests.odometry.odometries import build, motion_errors, poses, run, scans_of, street_scans, urban

LAST = se3.exp(torch.tensor([1.2, 0.1, 0, 0.01, 0, 0.05], dtype=torch.float64))


def test_ni_is_identity_and_cv_the_last_motion():
    points = torch.randn(10, 3)
    none, constant = NoInitialization().predict(points, LAST), ConstantVelocity().predict(points, LAST)
    assert torch.equal(none.T_previous_new, se3.identity()) and none.source == "ni"
    assert torch.equal(constant.T_previous_new, LAST) and constant.source == "cv"


def test_ei_recovers_planar_motion():
    elevation = ElevationImage()
    first = elevation.predict(urban().scan(0).points, LAST)
    assert first.source == "cv"
    for i in range(1, 4):
        guess = elevation.predict(urban().scan(i).points, se3.identity())
        assert guess.source == "ei"
        error = se3.to_euler(se3.inverse(se3.relative(urban().T_world_lidar)[i - 1]) @ guess.T_previous_new)
        assert error[:2].norm() < 0.25 and error[5].abs() < math.radians(0.7)
        assert guess.T_previous_new.dtype == torch.float64
        assert se3.to_euler(guess.T_previous_new)[2:5].abs().max() == 0


@pytest.mark.parametrize("yaw_deg", [-20.0, 8.0])
def test_ei_recovers_turn_on_the_spot(yaw_deg):
    elevation, points = ElevationImage(), urban().scan(0).points
    T_previous_new = se3.from_euler(torch.tensor([0.5, -0.3, 0, 0, 0, math.radians(yaw_deg)], dtype=torch.float64))
    elevation.predict(points, LAST)
    guess = elevation.predict(se3.transform(se3.inverse(T_previous_new), points), LAST)
    error = se3.to_euler(se3.inverse(T_previous_new) @ guess.T_previous_new)
    assert guess.source == "ei"
    assert error[:2].norm() < 0.2 and error[5].abs() < math.radians(0.5)


@pytest.mark.parametrize("points", [torch.zeros(0, 3), torch.tensor([[3.0, 1, 0.5]]), torch.full((500, 3), -1.0)])
def test_ei_without_features_falls_back_to_cv(points):
    elevation = ElevationImage()
    elevation.predict(urban().scan(0).points, LAST)
    guess = elevation.predict(points, LAST)
    assert guess.source == "cv" and torch.equal(guess.T_previous_new, LAST)
    after = elevation.predict(urban().scan(1).points, LAST)
    assert after.source == "cv"


def test_ei_with_inconsistent_matches_falls_back_to_cv():
    """Features of any two images match, even of unrelated ones."""
    elevation, generator = ElevationImage(min_inliers=60), torch.Generator().manual_seed(0)
    side = torch.arange(0, 2, 0.2)
    for _ in range(2):
        corners = 160 * torch.rand(600, 1, 2, generator=generator) - 80
        heights = 10 * torch.rand(600, 1, 1, generator=generator).expand(-1, 100, -1)
        boxes = torch.cat([corners + torch.cartesian_prod(side, side), heights], dim=2)
        guess = elevation.predict(boxes.flatten(0, 1), LAST)
    assert guess.source == "cv" and torch.equal(guess.T_previous_new, LAST)


def test_elevation_image_holds_greatest_height_of_each_cell():
    elevation = ElevationImage(size_px=10, pixel_m=1.0, max_height_m=10.0)
    points = torch.tensor([[0.5, 0.5, 2.0], [0.6, 0.4, 5.0], [-4.5, 3.5, 20.0], [2.5, 2.5, -1.0], [7.0, 0.0, 3.0]])
    image = elevation.image(points)
    assert image.shape == (10, 10) and image.dtype == "uint8"
    assert image[5, 5] == 1 + int(5.0 * 25.4) and image[8, 0] == 255
    assert (image > 0).sum() == 2


class _Network:
    """In place of a trained network: returns the numbers of activated pixels of the two images."""

    projection = SphericalProjection()
    device = torch.device("cpu")

    def relative_pose(self, reference: Tensor, target: Tensor) -> Tensor:
        T = se3.identity(len(reference))
        T[:, 0, 3] = (reference != 0).any(dim=1).sum()
        T[:, 1, 3] = (target != 0).any(dim=1).sum()
        return T


def test_posenet_gets_previous_and_new_scan():
    initialization = PoseNetInitialization(_Network())
    counts = [(_Network.projection.nearest_points(urban().scan(i).points) >= 0).sum() for i in range(3)]
    first = initialization.predict(urban().scan(0).points, LAST)
    assert torch.equal(first.T_previous_new, se3.identity()) and first.source == "posenet"
    for i in (1, 2):
        guess = initialization.predict(urban().scan(i).points, LAST)
        assert guess.T_previous_new[:2, 3].tolist() == [counts[i - 1], counts[i]]


def test_posenet_with_nan_estimate_falls_back_to_cv(monkeypatch):
    nowhere = torch.full((1, 4, 4), torch.nan, dtype=torch.float64)
    monkeypatch.setattr(_Network, "relative_pose", lambda network, reference, target: nowhere)
    initialization = PoseNetInitialization(_Network())
    guesses = [initialization.predict(torch.randn(10, 3), LAST) for _ in range(2)]
    assert guesses[1].source == "cv" and torch.equal(guesses[1].T_previous_new, LAST)


@pytest.mark.parametrize("T_previous_new", [torch.eye(4), torch.full((4, 4), torch.nan, dtype=torch.float64)])
def test_guess_that_is_no_pose_is_refused(T_previous_new):
    with pytest.raises(ValueError, match=r"initialization 'mine': T_previous_new must be a finite \(4, 4\)"):
        InitialMotion(T_previous_new, "mine")


def test_initialization_alone_accumulates_its_guesses():
    drive = urban()
    frames = run(build("ei"), scans_of(drive)[:4])
    assert torch.equal(frames[0].T_world_lidar, se3.identity())
    translations, _ = motion_errors(poses(frames), drive.T_world_lidar[:4])
    assert translations.max() < 0.4
    assert {frame.health.initialization for frame in frames[1:]} == {"ei"}
    assert all(torch.equal(T, se3.identity()) for T in poses(run(build("ni"), street_scans()[:3])))
