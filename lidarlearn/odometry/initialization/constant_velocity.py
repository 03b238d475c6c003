"""CV: constant velocity."""

from jaxtyping import Float
from torch import Tensor

from lidarlearn.odometry.initialization.base import Initialization, InitialMotion


class ConstantVelocity(Initialization):
    """The sensor moves as it did before. Source: Dellenbach et al. 2021, III-A "Initialization"."""

    def predict(self, points: Float[Tensor, "n 3"], last_motion: Float[Tensor, "4 4"]) -> InitialMotion:
        """The last motion."""
        return InitialMotion(last_motion, "cv")
