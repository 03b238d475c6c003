"""NI: no initialization."""

from jaxtyping import Float
from torch import Tensor

from lidarlearn.geometry import se3
from lidarlearn.odometry.initialization.base import Initialization, InitialMotion


class NoInitialization(Initialization):
    """The sensor did not move. Source: Dellenbach et al. 2021, IV-A "NI"."""

    def predict(self, points: Float[Tensor, "n 3"], last_motion: Float[Tensor, "4 4"]) -> InitialMotion:
        """The identity."""
        return InitialMotion(se3.identity(), "ni")
