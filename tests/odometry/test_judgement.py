import pytest
import torch

from lidarlearn.geometry import se3
from lidarlearn.geometry.se3 import MotionDifference
from lidarlearn.odometry.judgement import Judgement
from lidarlearn.registration.result import RegistrationResult

JUDGEMENT = Judgement(max_deviation_m=0.5, max_deviation_deg=8.0, min_gain=0.1)


def registered(
    overlap: float = 1.0, inlier_share: float = 1.0, fit: float = 1.0, information: float = 1.0
) -> RegistrationResult:
    """A registration with these shares, and nothing else."""
    shares = (torch.tensor(share) for share in (overlap, inlier_share, fit))
    nothing, of_each_axis = torch.zeros(6), torch.full((3,), information)
    return RegistrationResult(
        se3.identity(),
        nothing,
        1,
        torch.tensor(True),
        *shares,
        torch.tensor(0.0),
        torch.eye(6),
        of_each_axis,
        nothing[:3],
    )


def test_motion_is_plausible_if_both_changes_are_small():
    assert JUDGEMENT.is_plausible(MotionDifference(0.5, 8.0))
    assert not JUDGEMENT.is_plausible(MotionDifference(0.51, 0.0))
    assert not JUDGEMENT.is_plausible(MotionDifference(0.0, 8.1))


@pytest.mark.parametrize(
    ("deviation", "price"),
    [
        (MotionDifference(0.0, 0.0), 0.0),
        (MotionDifference(0.25, 0.0), 0.05),
        (MotionDifference(0.05, 6.0), 0.075),  # the larger of the two changes counts
        (MotionDifference(0.5, 0.0), 0.1),
        (MotionDifference(2.2, 30.0), 0.1),  # a scan may have been lost, or the sensor been turned by hand
    ],
)
def test_credibility_falls_with_deviation_up_to_min_gain(deviation, price):
    assert JUDGEMENT.credibility(0.6, deviation) == pytest.approx(0.6 - price)


@pytest.mark.parametrize(
    ("overlap", "inlier_share", "accepted"), [(0.5, 0.9, True), (0.02, 0.9, False), (0.5, 0.5, False)]
)
def test_registration_needs_overlap_and_inliers(overlap, inlier_share, accepted):
    assert Judgement().accepts(registered(overlap, inlier_share)) == accepted


@pytest.mark.parametrize(("fit", "information", "dropped"), [(0.6, 0.04, False), (0.3, 0.1, True), (0.6, 0.02, True)])
def test_has_dropped_compares_with_best_of_last_results(fit, information, dropped):
    judgement = Judgement(min_fit_share=0.7, min_information_share=0.3)
    last = [registered(fit=0.5, information=0.1), registered(fit=0.6, information=0.01)]
    result = registered(fit=fit, information=information)
    assert judgement.has_dropped(result, last) == dropped and not judgement.has_dropped(result, [])


@pytest.mark.parametrize("setting", ["max_deviation_m", "max_deviation_deg"])
def test_max_deviation_of_zero_is_refused(setting):
    with pytest.raises(ValueError, match=f"must be above 0.*{setting}=0"):
        Judgement(**{setting: 0.0})
