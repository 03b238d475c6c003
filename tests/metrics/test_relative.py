import math

import pytest
import torch
from evo.core import metrics
from evo.core.trajectory import PosePath3D

from lidarlearn.geometry import se3
from lidarlearn.metrics.relative import relative_errors, relative_pose_error, relative_translation_error, speeds


def evo_rpe(estimate, truth, relation):
    rpe = metrics.RPE(relation, delta=1, delta_unit=metrics.Unit.frames)
    rpe.process_data(tuple(PosePath3D(poses_se3=list(T.numpy())) for T in (truth, estimate)))
    return rpe.get_all_statistics()


def test_rpe_agrees_with_evo(winding_drive, perturbed):
    truth = winding_drive()
    estimate = perturbed(truth)
    ours = relative_pose_error(estimate, truth)
    assert ours is not None
    translation = evo_rpe(estimate, truth, metrics.PoseRelation.translation_part)
    rotation = evo_rpe(estimate, truth, metrics.PoseRelation.rotation_angle_rad)
    assert ours.translation_rmse_m == pytest.approx(translation["rmse"], rel=1e-9)
    assert ours.translation_mean_m == pytest.approx(translation["mean"], rel=1e-9)
    assert ours.rotation_rmse_rad == pytest.approx(rotation["rmse"], rel=1e-6)


@pytest.mark.parametrize("angle", [1e-9, 1e-6, 1e-3, 0.5, 3.0])
def test_rotation_error_is_accurate_from_tiny_to_large(angle):
    truth = se3.identity(2)
    estimate = se3.accumulate(se3.exp(torch.tensor([[0.3, 0, 0, 0, angle, 0]], dtype=torch.float64)))
    assert relative_errors(estimate, truth).rotation.item() == pytest.approx(angle, rel=1e-6)


def test_wrong_motion_affects_one_pair(winding_drive):
    truth = winding_drive(50)
    motions = se3.relative(truth)
    motions[20] = motions[20] @ se3.exp(torch.tensor([0, 0.3, 0.4, 0, 0, 0], dtype=torch.float64))
    errors = relative_errors(se3.accumulate(motions), truth)
    assert errors.translation[20] == pytest.approx(0.5)
    assert torch.cat([errors.translation[:20], errors.translation[21:]]).max() < 1e-12


def test_relative_errors_of_single_pose_are_none():
    assert relative_pose_error(se3.identity(1), se3.identity(1)) is None
    assert relative_translation_error(se3.identity(1), se3.identity(1)) is None


def test_relative_translation_error_is_share_of_motion(winding_drive):
    truth = winding_drive()
    assert relative_translation_error(truth, truth) == pytest.approx(0, abs=1e-12)
    assert relative_translation_error(se3.identity(len(truth)), truth) == pytest.approx(1)
    longer = se3.relative(truth)
    longer[:, :3, 3] *= 1.1
    assert relative_translation_error(se3.accumulate(longer), truth) == pytest.approx(0.1)


def test_relative_translation_error_without_motion_is_none(winding_drive):
    assert relative_translation_error(winding_drive(10), se3.identity(10)) is None


def test_relative_translation_error_is_mean_rpe_over_mean_motion(winding_drive, perturbed):
    truth = winding_drive()
    estimate = perturbed(truth)
    rpe = relative_pose_error(estimate, truth)
    assert rpe is not None
    motion = float(se3.relative(truth)[:, :3, 3].norm(dim=-1).mean())
    assert relative_translation_error(estimate, truth) == pytest.approx(rpe.translation_mean_m / motion)


def test_speeds_skip_pairs_without_elapsed_time(straight_line):
    times = torch.tensor([0.0, 0.5, 0.5, 1.5], dtype=torch.float64)
    assert speeds(straight_line(3), times).tolist() == [2.0, 1.0]


def test_relative_errors_refuse_infinite_values(straight_line):
    line = straight_line(5)
    broken = line.clone()
    broken[3, 0, 0] = math.inf
    with pytest.raises(ValueError, match="ground-truth pose 3"):
        relative_errors(line, broken)
