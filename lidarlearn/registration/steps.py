"""Steps of Gauss-Newton: small motions of the new scan, as (translation [m], rotation [rad]) and as transforms."""

import numpy as np
from jaxtyping import Float64
from scipy.spatial.transform import Rotation


def retraction(step: Float64[np.ndarray, "*batch 6"]) -> Float64[np.ndarray, "*batch 4 4"]:
    """The transform of a step: its rotation, then its translation. For small steps it agrees with `se3.exp`."""
    T = np.zeros((*step.shape[:-1], 4, 4))
    if step.size:  # SciPy < 1.16, the newest for Python 3.10, has no empty rotations
        T[..., :3, :3] = Rotation.from_rotvec(step[..., 3:].reshape(-1, 3)).as_matrix().reshape(*step.shape[:-1], 3, 3)
    T[..., :3, 3] = step[..., :3]
    T[..., 3, 3] = 1
    return T


def step_sizes(step: Float64[np.ndarray, "*batch 6"]) -> Float64[np.ndarray, "*batch 2"]:
    """Length of the translation [m] and angle of the rotation [rad]."""
    return np.linalg.norm(step.reshape(*step.shape[:-1], 2, 3), axis=-1)
