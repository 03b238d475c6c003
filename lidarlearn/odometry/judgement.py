"""The thresholds by which registrations are accepted, doubted and compared."""

from collections.abc import Collection
from dataclasses import dataclass

from lidarlearn.errors import require_positive
from lidarlearn.geometry.se3 import MotionDifference
from lidarlearn.registration.result import RegistrationResult


@dataclass(frozen=True)
class Judgement:
    """When a registration is accepted, and when it is doubted.

    Args:
        min_points: smallest number of points that is registered.
        min_overlap: smallest acceptable share of points that have a neighbour in the map.
        min_inlier_share: smallest acceptable share of these points that lie on the map's surface.
        min_fit_share: a registration is doubted if its `RegistrationResult.fit` is below this share of the best of the
            last scans, as after a turn so wide that the registration ends at a false fit.
        min_information_share: the same for `RegistrationResult.information` in the weakest direction. After a lost
            scan, ground rings may fit on the wrong rings, but then they hardly constrain the motion across them.
        min_information: the weakest direction is degenerate below this `RegistrationResult.information`, or below
            `GaussNewton.min_information`. Normals of noisy points look like information: up to 0.013 in a corridor,
            with projective association and 3 cm of noise. A street has 0.04 and more, a motorway as little as 0.004.
        max_deviation_m: largest plausible change of motion from one scan to the next [m]; 0.5 m at 10 Hz is an
            acceleration of 50 m/s^2.
        max_deviation_deg: largest plausible change of rotation from one scan to the next [deg].
        min_gain: an implausible change of motion is accepted only if its `GaussNewton.agreement` exceeds that of the
            unchanged motion by this much; smaller changes need proportionally less. A turn by 20 deg gains 0.2. On a
            motorway, in frame-to-frame registration, standing still agrees up to 0.02 better than driving.
        restart_after: number of scans in a row without an acceptable registration after which a new map is started.
    """

    min_points: int = 100
    min_overlap: float = 0.03
    min_inlier_share: float = 0.6
    min_fit_share: float = 0.7
    min_information_share: float = 0.3
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

    def has_dropped(self, result: RegistrationResult, last: Collection[RegistrationResult]) -> bool:
        """Whether the scan fits, or constrains its position, much less than the best of the last ones."""
        best_fit = max((other.fit.item() for other in last), default=0.0)
        most_information = max((other.information[0].item() for other in last), default=0.0)
        return (
            result.fit.item() < self.min_fit_share * best_fit
            or result.information[0].item() < self.min_information_share * most_information
        )

    def is_plausible(self, deviation: MotionDifference) -> bool:
        """Whether a vehicle can change its motion by this much in one scan."""
        return self._surprise(deviation) <= 1

    def credibility(self, agreement: float, deviation: MotionDifference) -> float:
        """Score by which candidate motions are ranked: agreement with the map minus a penalty for an abrupt change.

        Args:
            agreement: see `GaussNewton.agreement`, 0 to 1.
            deviation: difference from the last motion.
        """
        return agreement - self.min_gain * min(self._surprise(deviation), 1.0)

    def _surprise(self, deviation: MotionDifference) -> float:
        return max(deviation.distance_m / self.max_deviation_m, deviation.angle_deg / self.max_deviation_deg)
