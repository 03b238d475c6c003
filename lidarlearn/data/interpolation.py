"""Poses between poses."""

import torch
from jaxtyping import Float
from torch import Tensor

from lidarlearn.geometry import se3


def interpolate_poses(
    timestamps: Float[Tensor, "n"], T_world: Float[Tensor, "n 4 4"], queries: Float[Tensor, "m"]
) -> Float[Tensor, "m 4 4"]:
    """Poses at other times, with a constant twist between neighbours; beyond the ends the last twist goes on.

    Args:
        timestamps: of the poses [s], ascending, at least two.
        T_world: the poses, float64.
        queries: times asked for [s].
    """
    before = (torch.searchsorted(timestamps, queries, right=True) - 1).clamp(0, len(timestamps) - 2)
    share = (queries - timestamps[before]) / (timestamps[before + 1] - timestamps[before])
    twist = se3.log(se3.inverse(T_world[before]) @ T_world[before + 1])
    return T_world[before] @ se3.exp(share[:, None] * twist)
