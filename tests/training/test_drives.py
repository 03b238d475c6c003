"""Predicted drives and their errors."""

import pytest
import torch

from lidarlearn.geometry import se3
from lidarlearn.training.drives import DriveErrors, drive_errors, mean_errors, predicted_drive
from tests.box_world import BoxSequence


class Straight(BoxSequence):
    """A straight drive of steps of one metre."""

    def __init__(self, frames, truth=True):
        super().__init__("0", frames)
        T = se3.identity(frames)
        T[:, 0, 3] = torch.arange(frames)
        self.T_world_lidar = T if truth else None


def ahead(n, step=1.0):
    return torch.tensor([[step, 0, 0, 0, 0, 0]]).repeat(n, 1)


def test_exact_predictions_have_no_error():
    sequence = BoxSequence("1", frames=20)
    parameters = se3.to_euler(se3.relative(sequence.T_world_lidar))
    errors = drive_errors(predicted_drive(sequence, torch.arange(19), parameters))
    assert errors.mean_relative_translation_error_m < 1e-6
    assert errors.mean_relative_rotation_error_deg < 1e-4


@pytest.mark.parametrize("order", [[3, 1, 0, 2], [0, 0, 1, 2, 3, 3]], ids=["shuffled", "repeated"])
def test_predicted_drive_sorts_and_deduplicates_predictions(order):
    steps = torch.tensor([1.0, 2.0, 4.0, 8.0])
    parameters = torch.zeros(len(order), 6)
    parameters[:, 0] = steps[order]
    drive = predicted_drive(Straight(5), torch.tensor(order), parameters)
    assert drive.T_world_lidar[:, 0, 3].tolist() == [0, 1, 3, 7, 15]


def test_predicted_drive_ends_at_first_gap():
    drive = predicted_drive(Straight(9), torch.tensor([0, 1, 2, 5, 6]), ahead(5))
    assert len(drive.T_world_lidar) == len(drive.T_world_lidar_true) == 4


def test_drive_errors_match_closed_form_on_straight_drive():
    errors = drive_errors(predicted_drive(Straight(151), torch.arange(150), ahead(150, 1.1)))
    assert errors.mean_relative_translation_error_m == pytest.approx(0.1, rel=1e-5)
    assert errors.mean_relative_translation_error_percent == pytest.approx(10.0, rel=1e-5)
    assert errors.mean_relative_rotation_error_deg == pytest.approx(0, abs=1e-9)
    # A segment ends at the first scan beyond 100 m, which is at 101 m: 10.1 m off over the nominal 100 m.
    assert errors.avg_translation_error_percent == pytest.approx(10.1, rel=1e-5)


def test_average_translation_error_is_none_under_100_m():
    errors = drive_errors(predicted_drive(Straight(51), torch.arange(50), ahead(50)))
    assert errors.avg_translation_error_percent is None
    assert errors.mean_relative_translation_error_m == pytest.approx(0, abs=1e-9)


def test_drive_errors_are_none_without_truth_or_predictions():
    assert drive_errors(predicted_drive(Straight(5, truth=False), torch.arange(4), ahead(4))) is None
    assert drive_errors(predicted_drive(Straight(5), torch.zeros(0, dtype=torch.long), torch.zeros(0, 6))) is None


def test_mean_errors_skip_undefined_values():
    means = mean_errors([DriveErrors(2.0, 0.1, 10.0, 1.0), DriveErrors(None, 0.3, None, 2.0)])
    assert means["avg_translation_error_percent"] == 2.0
    assert means["mean_relative_translation_error_m"] == pytest.approx(0.2)
    assert means["mean_relative_translation_error_percent"] == 10.0
    assert mean_errors([]) == {}
