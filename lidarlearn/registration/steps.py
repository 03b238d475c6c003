"""Steps of Gauss-Newton: small motions of the new scan, as (translation [m], rotation [rad]) and as transforms."""

import numpy as np
from jaxtyping import Float64

_HATS = np.array([[0, 0, 0, 0, 0, -1, 0, 1, 0], [0, 0, 1, 0, 0, 0, -1, 0, 0], [0, -1, 0, 1, 0, 0, 0, 0, 0.0]])
_EYE = np.eye(3)


def retraction(step: Float64[np.ndarray, "*batch 6"]) -> Float64[np.ndarray, "*batch 4 4"]:
    """The transform of a step: its rotation, then its translation. For small steps it agrees with `se3.exp`."""
    angle = np.maximum(np.linalg.norm(step[..., 3:], axis=-1), 1e-9)[..., None, None]
    W = (step[..., 3:] @ _HATS).reshape(*step.shape[:-1], 3, 3)
    T = np.zeros((*step.shape[:-1], 4, 4))
    T[..., :3, :3] = _EYE + np.sin(angle) / angle * W + (1 - np.cos(angle)) / angle**2 * (W @ W)
    T[..., :3, 3] = step[..., :3]
    T[..., 3, 3] = 1
    return T


def step_sizes(step: Float64[np.ndarray, "*batch 6"]) -> Float64[np.ndarray, "*batch 2"]:
    """Length of the translation [m] and angle of the rotation [rad]."""
    return np.linalg.norm(step.reshape(*step.shape[:-1], 2, 3), axis=-1)
