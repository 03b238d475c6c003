"""Steps of Gauss-Newton: small motions of the new scan, as (translation [m], rotation [rad]) and as transforms."""

import numpy as np
from jaxtyping import Float64

_HATS = np.array([[0, 0, 0, 0, 0, -1, 0, 1, 0], [0, 0, 1, 0, 0, 0, -1, 0, 0], [0, -1, 0, 1, 0, 0, 0, 0, 0.0]])
_EYE = np.eye(3)


def motion(xi: Float64[np.ndarray, "*batch 6"]) -> Float64[np.ndarray, "*batch 4 4"]:
    """A translation and then a rotation; for the small ones that steps end in it is `se3.exp`."""
    angle = np.maximum(np.linalg.norm(xi[..., 3:], axis=-1), 1e-9)[..., None, None]
    W = (xi[..., 3:] @ _HATS).reshape(*xi.shape[:-1], 3, 3)
    T = np.zeros((*xi.shape[:-1], 4, 4))
    T[..., :3, :3] = _EYE + np.sin(angle) / angle * W + (1 - np.cos(angle)) / angle**2 * (W @ W)
    T[..., :3, 3] = xi[..., :3]
    T[..., 3, 3] = 1
    return T


def lengths(xi: Float64[np.ndarray, "*batch 6"]) -> Float64[np.ndarray, "*batch 2"]:
    """Translation [m] and angle [rad] of small motions."""
    return np.linalg.norm(xi.reshape(*xi.shape[:-1], 2, 3), axis=-1)
