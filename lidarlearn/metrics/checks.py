"""The check of two trajectories that every metric begins with."""

import torch
from jaxtyping import Float
from torch import Tensor


def check_comparable(T_estimate: Float[Tensor, "n 4 4"], T_ground_truth: Float[Tensor, "m 4 4"]) -> None:
    """Check that two trajectories can be compared pose by pose.

    Raises:
        ValueError: the numbers of poses differ, poses are not in double precision, or are not finite.
    """
    if len(T_estimate) != len(T_ground_truth):
        raise ValueError(f"{len(T_estimate)} estimated poses against {len(T_ground_truth)} of the ground truth")
    for name, T in (("estimated", T_estimate), ("ground-truth", T_ground_truth)):
        if T.dtype != torch.float64:
            raise ValueError(f"{name} poses must be float64 tensors, got {type(T).__name__} of {T.dtype}")
        finite = T.isfinite().all(-1).all(-1)
        if not bool(finite.all()):
            raise ValueError(f"{name} pose {int((~finite).int().argmax())} holds values that are not finite")
