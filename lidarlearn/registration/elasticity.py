"""Residual motion distortion: motion within a scan that remains after deskewing."""

import math
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float, Float64
from torch import Tensor

from lidarlearn.registration.normal_equations import NormalEquations

_MIN_VARIANCE_M2 = 1e-6  # of the residuals


@dataclass(frozen=True)
class Elasticity:
    """Prior on the residual motion of a scan, its skew.

    Deskewing assumes constant velocity; of the published scans of KITTI 04, two in five remain distorted by 9 cm from
    beginning to end. This motion is modelled as a twist proportional to time and estimated with the last Gauss-Newton
    step. The prior keeps it small, as a skew that all scans share hardly shows against a map of these scans.

    Args:
        translation_m: standard deviation of the skew over a scan period along each axis [m].
        rotation_deg: standard deviation of the skew over a scan period about each axis [deg].
        points_per_measurement: errors of neighbouring points are correlated; this many count as one independent
            measurement.

    Source: the idea of two poses a scan, Dellenbach et al., "CT-ICP", ICRA 2022.
    """

    translation_m: float = 0.05
    rotation_deg: float = 0.1
    points_per_measurement: float = 10.0

    def __post_init__(self) -> None:
        if not min(self.translation_m, self.rotation_deg, self.points_per_measurement) > 0:
            raise ValueError(f"registration: elasticity must be above 0, got {self}; none at all is elasticity=null")

    def equations(self, rigid: NormalEquations, phases: Float[Tensor, "n"]) -> "ElasticEquations":
        """Extend the normal equations of a pose by the skew.

        Args:
            rigid: equations of the pose of a rigid scan.
            phases: when each point was measured, as a share of the scan period.
        """
        across, within = rigid.terms.phase_moments(phases)
        variance = rigid.squares / np.maximum(np.trace(rigid.H[..., :3, :3], axis1=-2, axis2=-1), 1e-12)
        prior_variance = np.repeat([self.translation_m, math.radians(self.rotation_deg)], 3) ** 2
        prior_information = self.points_per_measurement * (variance + _MIN_VARIANCE_M2)[..., None] / prior_variance
        H_skew = within[..., :6, :6] + prior_information[..., None] * np.eye(6)
        gain = np.linalg.solve(H_skew, across[..., :6, :])  # for each component of the pose's step, and for no step
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
    """Normal equations of pose and skew, reduced to the pose by the Schur complement.

    Args:
        pose: the equations of the pose.
        gain: the skew is -gain times (step of the pose, 1).
    """

    pose: NormalEquations
    gain: Float64[np.ndarray, "*batch 6 7"]

    def skew(self, step: Float64[np.ndarray, "*batch 6"]) -> Float64[np.ndarray, "*batch 6"]:
        """The skew for a step of the pose: a twist over a scan period, (translation [m], rotation [rad])."""
        return -(self.gain[..., :6] @ step[..., None])[..., 0] - self.gain[..., 6]
