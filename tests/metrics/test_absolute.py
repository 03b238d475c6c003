import copy

import pytest
import torch
from evo.core import metrics
from evo.core.trajectory import PosePath3D
from scipy.spatial.transform import Rotation

from lidarlearn.geometry import se3
from lidarlearn.metrics.absolute import absolute_errors, align, ape_rmse

MOVED = se3.exp(torch.tensor([30.0, -4.0, 2.0, 0.4, -0.2, 1.3], dtype=torch.float64))


def evo_ape_rmse(estimate, truth):
    reference, moved = (PosePath3D(poses_se3=list(copy.deepcopy(T.numpy()))) for T in (truth, estimate))
    moved.align(reference)
    ape = metrics.APE(metrics.PoseRelation.translation_part)
    ape.process_data((reference, moved))
    return ape.get_statistic(metrics.StatisticsType.rmse)


@pytest.mark.parametrize("seed", range(3))
def test_ape_agrees_with_evo(winding_drive, perturbed, seed):
    truth = winding_drive()
    estimate = MOVED @ perturbed(truth, scale=2.0, seed=seed)
    assert ape_rmse(estimate, truth) == pytest.approx(evo_ape_rmse(estimate, truth), abs=1e-9)


def test_ape_does_not_depend_on_world_frame(winding_drive):
    truth = winding_drive()
    assert ape_rmse(MOVED @ truth, truth) == pytest.approx(0, abs=1e-10)


def test_align_does_not_estimate_scale(straight_line):
    """The error of points on a line, 10 % too far apart, is a tenth of their standard deviation."""
    truth = straight_line(100)
    estimate = truth.clone()
    estimate[:, 0, 3] *= 1.1
    expected = 0.1 * float(truth[:, 0, 3].std(correction=0))
    assert ape_rmse(MOVED @ estimate, truth) == pytest.approx(expected, rel=1e-9)


@pytest.mark.parametrize("direction", [(1.0, 0.0, 0.0), (0.0, 0.0, 1.0), (1.0, -2.0, 3.0), (-1.0, 0.0, 0.0)])
def test_align_straight_lines(straight_line, direction):
    """The covariance has rank one: the rotation about the line is arbitrary, the error is not."""
    truth = straight_line(300)
    axis = torch.tensor(direction, dtype=torch.float64)
    estimate = truth.clone()
    estimate[:, :3, 3] = truth[:, :1, 3] * axis / axis.norm() + 5
    R = align(truth[:, :3, 3], estimate[:, :3, 3])[:3, :3]
    assert torch.allclose(R @ R.mT, torch.eye(3, dtype=torch.float64), atol=1e-12)
    assert torch.linalg.det(R) == pytest.approx(1)
    assert ape_rmse(estimate, truth) == pytest.approx(0, abs=1e-10)


def test_ape_of_two_poses_is_half_their_difference_in_distance(straight_line):
    truth, estimate = straight_line(1), straight_line(1)
    estimate[1, 0, 3] = 1.4
    assert ape_rmse(MOVED @ estimate, truth) == pytest.approx(0.2, abs=1e-12)


def test_ape_of_three_poses_and_of_coincident_poses(winding_drive):
    truth = winding_drive(3)
    assert ape_rmse(MOVED @ truth, truth) == pytest.approx(0, abs=1e-12)
    standing = se3.identity(4)
    assert ape_rmse(MOVED @ standing, standing) == pytest.approx(0, abs=1e-12)


def test_ape_of_one_pose_is_none():
    assert ape_rmse(se3.identity(1), se3.identity(1)) is None


def test_align_does_not_mirror(winding_drive):
    truth = winding_drive()
    mirrored = truth.clone()
    mirrored[:, :3, 3] *= torch.tensor([1.0, 1.0, -1.0], dtype=torch.float64)
    mirrored[:, 1, 3] *= -1
    mirrored[:, 0, 3] *= -1
    T = align(truth[:, :3, 3], mirrored[:, :3, 3])
    assert torch.linalg.det(T[:3, :3]) == pytest.approx(1)
    assert ape_rmse(mirrored, truth) > 0.1


def test_align_agrees_with_scipy(winding_drive, perturbed):
    truth = winding_drive()
    estimate = MOVED @ perturbed(truth, scale=5.0)
    target, source = truth[:, :3, 3], estimate[:, :3, 3]
    expected, _ = Rotation.align_vectors((target - target.mean(0)).numpy(), (source - source.mean(0)).numpy())
    R = align(target, source)[:3, :3]
    assert torch.allclose(R, torch.from_numpy(expected.as_matrix()), atol=1e-9)


def test_absolute_errors_have_ape_as_rms(winding_drive, perturbed):
    truth = winding_drive()
    errors = absolute_errors(perturbed(truth), truth)
    assert errors.shape == (len(truth),)
    assert errors.square().mean().sqrt() == pytest.approx(ape_rmse(perturbed(truth), truth))


def test_ape_refuses_different_numbers_of_poses():
    with pytest.raises(ValueError, match="1 estimated poses against 3"):
        ape_rmse(se3.identity(1), se3.identity(3))
