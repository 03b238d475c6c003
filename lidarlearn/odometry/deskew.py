"""Compensation of the sensor's motion during a scan."""

import torch
from jaxtyping import Float
from torch import Tensor

from lidarlearn.geometry import se3

_STEPS = 256  # of the scan period; 0.1 ms at 10 Hz, 3 mm at 110 km/h


def deskew(
    points: Float[Tensor, "n 3"], times: Float[Tensor, "n"] | None, motion_per_period: Float[Tensor, "4 4"]
) -> Float[Tensor, "n 3"]:
    """The points as if all had been measured at the instant of the scan's pose, under constant velocity.

    Args:
        points: as measured [m], each in the sensor's frame at its own instant.
        times: time of each point from the instant of the pose, as a share of the scan period, see
            `lidarlearn.data.sequence.Scan`; None: there is nothing to compensate.
        motion_per_period: the motion over one scan period.
    """
    if times is None or not len(points):
        return points
    earliest, latest = torch.stack(times.aminmax()).cpu().tolist()
    step = ((times - earliest) / max(latest - earliest, 1e-6) * (_STEPS - 1)).round().long()
    instants = torch.linspace(earliest, latest, _STEPS, dtype=torch.float64)
    T_pose_instant = se3.exp(instants[:, None] * se3.log(motion_per_period)).to(points)
    rows = T_pose_instant[:, :3].permute(1, 2, 0).contiguous()  # each element contiguous over the instants
    x, y, z = points.unbind(1)
    coordinates = []
    for row in rows:
        a, b, c, t = row.index_select(1, step)
        coordinates.append(t.addcmul_(a, x).addcmul_(b, y).addcmul_(c, z))
    return torch.stack(coordinates).mT
