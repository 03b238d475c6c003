"""When a registration is doubted."""

from dataclasses import dataclass

from lidarlearn.errors import require_positive
from lidarlearn.geometry.se3 import MotionDifference
from lidarlearn.registration.result import RegistrationResult


@dataclass(frozen=True)
class Judgement:
    """When a registration is doubted.

    Args:
        min_points: fewest points that can be registered.
        min_overlap: smallest acceptable share of points that have a neighbour in the map.
        min_inlier_share: smallest acceptable share of those that fit it.
        min_fit_share: smallest expected `RegistrationResult.fit` as a share of the best of the last scans: below it,
            other motions are tried, as after a turn that is too wide to be pulled in and finds a false fit near by.
        min_information: the weakest direction counts as degenerate below it, see `RegistrationResult.information`, and
            below that of the registration, which holds what it knows less of.
            Normals of noisy points pose as information: up to 0.013 in a corridor, with projective association and
            3 cm of noise; a street has 0.04 and more, a motorway as little as 0.004.
        max_deviation_m: largest plausible change of motion from one scan to the next [m]; 0.5 m at 10 Hz is an
            acceleration of 50 m/s^2.
        max_deviation_deg: largest plausible change of rotation from one scan to the next [deg].
        min_gain: an implausible change of motion is believed only if the scan agrees so much better with it than with
            no change, see `GaussNewton.agreement`: by 0.2 after a turn of 20 deg; a smaller change with less, in
            proportion.
            Registered to the previous scan alone, standing still agrees by up to 0.02 better than driving on a
            motorway.
        restart_after: with so many scans in a row without an acceptable registration the map is begun anew.
    """

    min_points: int = 100
    min_overlap: float = 0.03
    min_inlier_share: float = 0.6
    min_fit_share: float = 0.7
    min_information: float = 0.01
    max_deviation_m: float = 0.5
    max_deviation_deg: float = 8.0
    min_gain: float = 0.1
    restart_after: int = 5

    def __post_init__(self) -> None:
        require_positive("judgement", max_deviation_m=self.max_deviation_m, max_deviation_deg=self.max_deviation_deg)

    def accepts(self, result: RegistrationResult) -> bool:
        """Whether enough of the scan fits the map."""
        return result.overlap.item() >= self.min_overlap and result.inlier_share.item() >= self.min_inlier_share

    def is_plausible(self, deviation: MotionDifference) -> bool:
        """Whether a motion that differs so much from the one before it can follow it."""
        return self._surprise(deviation) <= 1

    def credibility(self, agreement: float, deviation: MotionDifference) -> float:
        """By what motions are compared: how well the scan agrees with one, less what it takes to believe it.

        Args:
            agreement: see `GaussNewton.agreement`, 0..1.
            deviation: how far it is from the motion before it.
        """
        return agreement - self.min_gain * min(self._surprise(deviation), 1.0)

    def _surprise(self, deviation: MotionDifference) -> float:
        return max(deviation.distance_m / self.max_deviation_m, deviation.angle_deg / self.max_deviation_deg)
