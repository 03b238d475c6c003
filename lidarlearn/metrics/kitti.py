"""KITTI's odometry metric: drift over segments of 100 to 800 m, as a share of their length.

Source: Geiger, Lenz, Urtasun, "Are we ready for autonomous driving?", CVPR 2012, and the benchmark's development kit.
The kit keeps distances and the cosine of the rotation error in single precision; here everything is double.
"""

import math
from dataclasses import dataclass

import torch
from jaxtyping import Float, Int
from torch import Tensor

from lidarlearn.metrics.checks import check_comparable

SEGMENT_LENGTHS_M = (100, 200, 300, 400, 500, 600, 700, 800)
START_STEP = 10  # frames between the starts of segments


@dataclass(frozen=True)
class SegmentErrors:
    """Error of every segment of a trajectory, ordered by first frame, then by length.

    Args:
        first_frame: frame at which the segment starts.
        length_m: its nominal length [m], one of `SEGMENT_LENGTHS_M`.
        translation: translation error over the nominal length, a ratio.
        rotation: rotation error over the nominal length [rad/m].
    """

    first_frame: Int[Tensor, "s"]
    length_m: Float[Tensor, "s"]
    translation: Float[Tensor, "s"]
    rotation: Float[Tensor, "s"]


@dataclass(frozen=True)
class SegmentAverage:
    """Mean over segments, in the units of the benchmark's tables."""

    segments: int
    translation_percent: float
    rotation_deg_per_100m: float


def path_distances(T_world: Float[Tensor, "n 4 4"]) -> Float[Tensor, "n"]:
    """Distance driven up to each pose [m], in 3D; 0 at the first."""
    steps = T_world[:, :3, 3].diff(dim=0).norm(dim=-1)
    return torch.cat([steps.new_zeros(min(len(T_world), 1)), steps.cumsum(0)])


def segment_errors(T_estimate: Float[Tensor, "n 4 4"], T_ground_truth: Float[Tensor, "m 4 4"]) -> SegmentErrors:
    """Relative errors over all segments: one for every tenth frame and each of the eight lengths the path still holds.

    A segment ends at the first frame strictly farther than its nominal length along the ground truth. Matrices are
    inverted in general: published poses are rotations to seven digits only, for which a transpose would differ visibly.

    Args:
        T_estimate: absolute poses in the frame in which the data set defines its metric (KITTI: the left camera).
        T_ground_truth: the same number of poses, in the same frame.

    Raises:
        ValueError: the numbers of poses differ, or poses are not finite.
    """
    check_comparable(T_estimate, T_ground_truth)
    first, last, length_m = _segments(path_distances(T_ground_truth))
    T_error = torch.linalg.inv(_between(T_estimate, first, last)) @ _between(T_ground_truth, first, last)
    cosine = (T_error[:, :3, :3].diagonal(dim1=-2, dim2=-1).sum(-1) - 1) / 2
    return SegmentErrors(
        first_frame=first,
        length_m=length_m,
        translation=T_error[:, :3, 3].norm(dim=-1) / length_m,
        rotation=cosine.clamp(-1, 1).acos() / length_m,
    )


def average(errors: SegmentErrors) -> SegmentAverage | None:
    """Mean error over all segments; None if the path is too short for any."""
    if not len(errors.length_m):
        return None
    return SegmentAverage(
        segments=len(errors.length_m),
        translation_percent=100 * float(errors.translation.mean()),
        rotation_deg_per_100m=100 * math.degrees(float(errors.rotation.mean())),
    )


def average_by_length(errors: SegmentErrors) -> dict[int, SegmentAverage]:
    """Mean error over the segments of each nominal length [m]; lengths without segments are left out."""
    averages = {length: average(_select(errors, errors.length_m == length)) for length in SEGMENT_LENGTHS_M}
    return {length: mean for length, mean in averages.items() if mean is not None}


def _segments(distances: Float[Tensor, "n"]) -> tuple[Int[Tensor, "s"], Int[Tensor, "s"], Float[Tensor, "s"]]:
    """First frame, last frame and nominal length [m] of every segment that ends within the path."""
    starts = torch.arange(0, len(distances), START_STEP, device=distances.device)
    lengths = torch.tensor(SEGMENT_LENGTHS_M, dtype=distances.dtype, device=distances.device)
    first = starts.repeat_interleave(len(lengths))
    length_m = lengths.repeat(len(starts))
    last = torch.searchsorted(distances, distances[first] + length_m, right=True)  # right: the first one beyond
    inside = last < len(distances)
    return first[inside], last[inside], length_m[inside]


def _between(T_world: Float[Tensor, "n 4 4"], first: Int[Tensor, "s"], last: Int[Tensor, "s"]) -> Tensor:
    """`T_first_last` of each segment."""
    return torch.linalg.inv(T_world[first]) @ T_world[last]


def _select(errors: SegmentErrors, chosen: Tensor) -> SegmentErrors:
    return SegmentErrors(
        errors.first_frame[chosen],
        errors.length_m[chosen],
        errors.translation[chosen],
        errors.rotation[chosen],
    )
