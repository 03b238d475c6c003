"""Interpolation of ground-truth poses, and which scans they cover."""

import logging

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from lidarlearn.geometry import se3

_log = logging.getLogger(__name__)

_LONGEST_GAP_S = 1.0  # between two poses; scans in longer gaps are reported


def interpolate_poses(
    timestamps: Float[Tensor, "n"], T_world: Float[Tensor, "n 4 4"], queries: Float[Tensor, "m"]
) -> Float[Tensor, "m 4 4"]:
    """Poses at other times, with a constant twist between neighbours, which continues beyond the ends.

    Args:
        timestamps: of the poses [s], ascending, at least two.
        T_world: the poses, float64.
        queries: times of the wanted poses [s].
    """
    before = (torch.searchsorted(timestamps, queries, right=True) - 1).clamp(0, len(timestamps) - 2)
    share = (queries - timestamps[before]) / (timestamps[before + 1] - timestamps[before])
    twist = se3.log(se3.inverse(T_world[before]) @ T_world[before + 1])
    return T_world[before] @ se3.exp(share[:, None] * twist)


def covered(
    name: str, timestamps: Float[Tensor, "n"], truth_timestamps: Float[Tensor, "m"], slack_s: float = 0.0
) -> list[int]:
    """Indices of the scans within the time of the ground truth; warns of scans outside of it or in its gaps.

    Args:
        name: of the sequence.
        timestamps: of the scans [s].
        truth_timestamps: of the ground-truth poses [s], ascending, at least two.
        slack_s: how long before the first or after the last pose a scan may be [s].
    """
    inside = (timestamps >= truth_timestamps[0] - slack_s) & (timestamps <= truth_timestamps[-1] + slack_s)
    if not inside.all():
        _log.warning("%s: %d scans before or after the ground truth are left out", name, int((~inside).sum()))
    after = torch.searchsorted(truth_timestamps, timestamps).clamp(1, len(truth_timestamps) - 1)
    in_hole = inside & (truth_timestamps[after] - truth_timestamps[after - 1] > _LONGEST_GAP_S)
    if in_hole.any():
        _log.warning(
            "%s: %d scans lie in holes of the ground truth longer than %g s", name, int(in_hole.sum()), _LONGEST_GAP_S
        )
    return np.flatnonzero(inside.numpy()).tolist()
