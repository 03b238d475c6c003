"""One registration of a scan: the guess it starts from, its result, and reasons to doubt it."""

import math
from dataclasses import dataclass

from jaxtyping import Float
from torch import Tensor

from lidarlearn.geometry.se3 import MotionDifference
from lidarlearn.odometry.health import Health, Status
from lidarlearn.registration.result import RegistrationResult


@dataclass(frozen=True)
class Guess:
    """A motion from which a scan is registered.

    Args:
        T_previous_new: the motion.
        source: where the guess comes from; only shown in the health record.
        error_m: how far points may be from where the guess puts them [m].
    """

    T_previous_new: Float[Tensor, "4 4"]
    source: str
    error_m: float


@dataclass(frozen=True)
class Attempt:
    """A registration from one guess.

    Args:
        guess: the guess.
        result: the registration.
        T_previous_new: the registered motion.
        deviation: difference between that motion and constant velocity.
        is_implausible: whether the deviation is more than a vehicle can do in one scan.
        is_degenerate: whether there is too little information along one direction to rely on the motion along it.
    """

    guess: Guess
    result: RegistrationResult
    T_previous_new: Float[Tensor, "4 4"]
    deviation: MotionDifference
    is_implausible: bool
    is_degenerate: bool

    def health(self, frame: int, points: int, status: Status) -> Health:
        """The health record of a frame whose final attempt this is.

        Args:
            frame: index of the scan.
            points: number of points to register.
            status: the outcome of the attempt.
        """
        result = self.result
        return Health(
            frame=frame,
            status=status,
            initialization=self.guess.source,
            points=points,
            iterations=result.iterations,
            converged=bool(result.converged),
            overlap=result.overlap.item(),
            inlier_share=result.inlier_share.item(),
            rmse_m=result.rmse_m.item(),
            skew_m=result.skew[:3].norm().item(),
            skew_deg=math.degrees(result.skew[3:].norm().item()),
            min_information=result.information[0].item(),
            degenerate=self.is_degenerate,
            weakest_direction=tuple(result.weakest_direction.tolist()),
            deviation_m=self.deviation.distance_m,
            deviation_deg=self.deviation.angle_deg,
            implausible=self.is_implausible,
        )
