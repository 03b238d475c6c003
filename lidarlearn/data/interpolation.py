"""Interpolation of ground-truth poses, and which scans they cover."""

import logging
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from lidarlearn.data.errors import DamagedFileError
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
    path: Path,
    name: str,
    timestamps: Float[Tensor, "n"],
    truth_timestamps: Float[Tensor, "m"],
    slack_s: float = 0.0,
) -> list[int]:
    """Indices of the scans within the time of the ground truth; warns of scans outside of it or in its gaps.

    Args:
        path: of the ground truth.
        name: of the sequence.
        timestamps: of the scans [s], at least one.
        truth_timestamps: of the ground-truth poses [s], ascending.
        slack_s: how long before the first or after the last pose a scan may be [s].

    Raises:
        DamagedFileError: there is only one pose, or no scan is within the time of the poses.
    """
    if len(truth_timestamps) < 2:
        raise DamagedFileError(path, f"{len(truth_timestamps)} poses with a time, where at least two are needed")
    first_s, last_s = truth_timestamps[0], truth_timestamps[-1]
    inside = (timestamps >= first_s - slack_s) & (timestamps <= last_s + slack_s)
    if not inside.any():
        raise DamagedFileError(
            path,
            f"its times ({first_s:.3f} to {last_s:.3f} s) do not overlap with those of the scans of {name}"
            f" ({timestamps.min():.3f} to {timestamps.max():.3f} s)",
            "use the poses of this recording, on the same clock as its scans",
        )
    if not inside.all():
        _log.warning("%s: %d scans before or after the ground truth are left out", name, int((~inside).sum()))
    after = torch.searchsorted(truth_timestamps, timestamps).clamp(1, len(truth_timestamps) - 1)
    in_hole = inside & (truth_timestamps[after] - truth_timestamps[after - 1] > _LONGEST_GAP_S)
    if in_hole.any():
        _log.warning(
            "%s: %d scans lie in holes of the ground truth longer than %g s", name, int(in_hole.sum()), _LONGEST_GAP_S
        )
    return np.flatnonzero(inside.numpy()).tolist()
