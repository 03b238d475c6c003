"""Correction of the known error in the HDL-64's factory calibration: all beams point slightly too low."""

import math

import torch
from jaxtyping import Float
from torch import Tensor


def raise_beams(points: Float[Tensor, "*batch n 3"], angle_deg: float) -> Float[Tensor, "*batch n 3"]:
    """Points with all elevations raised by a constant angle; ranges and azimuths stay the same.

    Each point p is rotated by `angle_deg` about p x (0, 0, 1), towards +z. Points on the z axis have no such axis and
    stay where they are.

    Args:
        points: in the sensor frame [m].
        angle_deg: 0.205 for KITTI; without it trajectories bend upwards and the translation error about doubles.

    Source: J.-E. Deschaud, IMLS-SLAM, ICRA 2018, who reports the wrong angles; the value as in CT-ICP (Dellenbach et
    al. 2022) and KISS-ICP (Vizzo et al. 2023).
    """
    x, y, z = points.unbind(-1)
    c, s = math.cos(math.radians(angle_deg)), math.sin(math.radians(angle_deg))
    ground_range = torch.hypot(x, y)
    off_axis = ground_range > 0
    scale = c - s * z / torch.where(off_axis, ground_range, 1.0)
    raised = torch.stack([scale * x, scale * y, c * z + s * ground_range], dim=-1)
    return torch.where(off_axis[..., None], raised, points)
