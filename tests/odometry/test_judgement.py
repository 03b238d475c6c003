import pytest

from lidarlearn.geometry.se3 import MotionDifference
from lidarlearn.odometry.judgement import Judgement

JUDGEMENT = Judgement(max_deviation_m=0.5, max_deviation_deg=8.0, min_gain=0.1)


def test_a_motion_follows_another_if_both_its_changes_are_small():
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
def test_a_change_of_motion_must_agree_better_in_proportion_and_by_no_more_than_the_gain(deviation, price):
    assert JUDGEMENT.credibility(0.6, deviation) == pytest.approx(0.6 - price)


@pytest.mark.parametrize("setting", ["max_deviation_m", "max_deviation_deg"])
def test_changes_of_motion_that_are_plausible_have_a_size(setting):
    with pytest.raises(ValueError, match=f"must be above 0.*{setting}=0"):
        Judgement(**{setting: 0.0})
