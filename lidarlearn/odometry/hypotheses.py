"""Motions worth trying when there is no good guess: at the start, and after a surprise."""

import math

import torch
from jaxtyping import Float
from torch import Tensor

from lidarlearn.geometry import se3

# Up to 108 km/h at 10 Hz, at intervals that ICP can bridge; backward too, for sensors mounted facing backward.
_FORWARD_M = (-3.0, -2.25, -1.5, -0.75, 0.75, 1.5, 2.25, 3.0)
_YAWS_DEG = (-25.0, -16.0, -8.0, 8.0, 16.0, 25.0)


def start_motions(T_guess: Float[Tensor, "4 4"]) -> Float[Tensor, "h 4 4"]:
    """Standing still, driving either way at up to 108 km/h, turning on the spot, and the guess unless it is zero."""
    parameters = torch.zeros(1 + len(_FORWARD_M) + len(_YAWS_DEG), 6, dtype=torch.float64)
    parameters[1 : 1 + len(_FORWARD_M), 0] = torch.tensor(_FORWARD_M)
    parameters[1 + len(_FORWARD_M) :, 5] = torch.tensor(_YAWS_DEG) * (math.pi / 180)
    motions = se3.from_euler(parameters)
    return motions if torch.equal(T_guess, motions[0]) else torch.cat([motions, T_guess[None]])


def surprise_motions(T_guess: Float[Tensor, "4 4"], T_last_motion: Float[Tensor, "4 4"]) -> Float[Tensor, "h 4 4"]:
    """The guess, the last motion, twice it (a lost scan), none (a repeated scan), and turns from the last motion."""
    turns = torch.zeros(len(_YAWS_DEG), 6, dtype=torch.float64)
    turns[:, 5] = torch.tensor(_YAWS_DEG) * (math.pi / 180)
    few = torch.stack([T_guess, T_last_motion, T_last_motion @ T_last_motion, se3.identity()])
    return torch.cat([few, T_last_motion @ se3.from_euler(turns)])
