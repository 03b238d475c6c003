import math

import pytest
import torch

from lidarlearn.geometry import se3
from lidarlearn.metrics.failures import registration_failures


def with_errors(T_world, errors):
    """The drive with changes to the Euler parameters of some motions."""
    parameters = se3.to_euler(se3.relative(T_world))
    for pair, change in errors.items():
        parameters[pair] += torch.tensor(change, dtype=torch.float64)
    return se3.accumulate(se3.from_euler(parameters))


def test_good_trajectory_has_no_failures(winding_drive, perturbed):
    truth = winding_drive()
    assert not registration_failures(perturbed(truth), truth).any()


def test_failures_are_motions_beyond_limits(winding_drive):
    truth = winding_drive(60)
    degree = math.radians(1)
    errors = {
        5: (1.01, 0, 0, 0, 0, 0),  # too far
        10: (0.99, 0, 0, 0, 0, 0),
        20: (0.8, 0.8, 0, 0, 0, 0),  # too far in both combined
        30: (0, 0, 0, 0, 0, 3.01 * degree),  # turned too much
        40: (0, 0, 0, 0, 0, 2.99 * degree),
        50: (0, 0, 0, 2 * degree, 2 * degree, 2 * degree),  # the norm of the three is 3.46 deg
    }
    failures = registration_failures(with_errors(truth, errors), truth)
    assert failures.shape == (59,)
    assert failures.nonzero().flatten().tolist() == [5, 20, 30, 50]


def test_failure_affects_one_motion_alone(winding_drive):
    truth = winding_drive(60)
    estimate = with_errors(truth, {10: (5.0, 0, 0, 0, 0, 1.0)})
    assert int(registration_failures(estimate, truth).sum()) == 1


def test_angles_are_compared_modulo_full_turn():
    truth = se3.accumulate(se3.from_euler(torch.tensor([[1, 0, 0, 0, 0, math.pi - 0.01]], dtype=torch.float64)))
    estimate = se3.accumulate(se3.from_euler(torch.tensor([[1, 0, 0, 0, 0, 0.01 - math.pi]], dtype=torch.float64)))
    assert not registration_failures(estimate, truth).any()


@pytest.mark.parametrize(("metres", "degrees", "count"), [(1.0, 3.0, 2), (0.1, 3.0, 3), (1.0, 30.0, 1)])
def test_failure_limits_are_arguments(winding_drive, metres, degrees, count):
    errors = {3: (2.0, 0, 0, 0, 0, 0), 6: (0.5, 0, 0, 0, 0, 0), 9: (0, 0, 0, 0, 0, 0.1)}
    truth = winding_drive(20)
    failures = registration_failures(with_errors(truth, errors), truth, metres, degrees)
    assert int(failures.sum()) == count


def test_single_pose_has_no_failures():
    assert registration_failures(se3.identity(1), se3.identity(1)).shape == (0,)
