"""Scans that give way: the motion during a scan that its compensation left over."""

import math
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float, Float64
from torch import Tensor

from lidarlearn.registration.normal_equations import NormalEquations

_MIN_VARIANCE_M2 = 1e-6  # of the residuals


@dataclass(frozen=True)
class Elasticity:
    """How much motion is left over in a scan, once it is compensated.

    Scans are compensated as if they moved evenly, or by whoever published them: in KITTI 04 two of five are skewed by
    9 cm from their beginning to their end. What is left is taken for a twist in proportion to time. It is estimated
    together with the last step of a registration, and expected to be small: of a skew that all scans share, a map of
    the same scans says little.

    Args:
        translation_m: how much of it is expected over a scan period, along each axis, as a standard deviation [m].
        rotation_deg: likewise, about each axis [deg].
        points_per_measurement: neighbouring points err alike: so many say as much as one by itself would.

    Source: the idea of two poses a scan, Dellenbach et al., "CT-ICP", ICRA 2022.
    """

    translation_m: float = 0.05
    rotation_deg: float = 0.1
    points_per_measurement: float = 10.0

    def __post_init__(self) -> None:
        if not min(self.translation_m, self.rotation_deg, self.points_per_measurement) > 0:
            raise ValueError(f"registration: elasticity must be above 0, got {self}; none at all is elasticity=null")

    def equations(self, rigid: NormalEquations, phases: Float[Tensor, "n"]) -> "ElasticEquations":
        """Those of pose and skew together.

        Args:
            rigid: those of the pose alone.
            phases: when each point was measured, as a share of the scan period.
        """
        across, within = rigid.terms.phase_moments(phases)
        variance = rigid.squares / np.maximum(np.trace(rigid.H[..., :3, :3], axis1=-2, axis2=-1), 1e-12)
        expected = np.repeat([self.translation_m, math.radians(self.rotation_deg)], 3) ** 2
        held = self.points_per_measurement * (variance + _MIN_VARIANCE_M2)[..., None] / expected
        H_skew = within[..., :6, :6] + held[..., None] * np.eye(6)
        gain = np.linalg.solve(H_skew, across[..., :6, :])  # of the skew by the pose's six unknowns, and by itself
        return ElasticEquations(
            pose=replace(
                rigid,
                H=rigid.H - across[..., :6, :6] @ gain[..., :6],
                g=rigid.g - (across[..., :6, :6] @ gain[..., 6:])[..., 0],
            ),
            gain=gain,
        )


@dataclass(frozen=True)
class ElasticEquations:
    """Normal equations of a scan that gives way.

    Args:
        pose: of the pose, with the skew eliminated.
        gain: how the skew follows the pose: by -gain times (step, 1).
    """

    pose: NormalEquations
    gain: Float64[np.ndarray, "*batch 6 7"]

    def skew(self, step: Float64[np.ndarray, "*batch 6"]) -> Float64[np.ndarray, "*batch 6"]:
        """The twist over a scan period, as (translation [m], rotation [rad]), that goes with a step of the pose."""
        return -(self.gain[..., :6] @ step[..., None])[..., 0] - self.gain[..., 6]
