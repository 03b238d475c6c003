"""Rigid motions: SE(3) as 4x4 matrices, its tangent vectors, and the network's Euler angles.

Tangent vectors are ordered (translation, rotation). All functions but `motion_difference` are batched, differentiable
(also at the identity) and keep the dtype and device of their arguments. Poses are float64 by convention, see
`lidarlearn.odometry`.
"""

import math
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn.functional import pad

# Below this angle [rad] closed forms lose digits to cancellation and Taylor series take over.
_SMALL_ANGLE = 1e-2


def identity(*batch: int, dtype: torch.dtype = torch.float64, device: torch.device | None = None) -> Tensor:
    """Identity transforms of shape (*batch, 4, 4)."""
    return torch.eye(4, dtype=dtype, device=device).expand(*batch, 4, 4).clone()


def from_rotation_translation(
    R: Float[Tensor, "*batch 3 3"], t: Float[Tensor, "*batch 3"]
) -> Float[Tensor, "*batch 4 4"]:
    """The transform x -> R x + t."""
    T = pad(torch.cat([R, t[..., None]], dim=-1), (0, 0, 0, 1))
    T[..., 3, 3] = 1
    return T


def inverse(T: Float[Tensor, "*batch 4 4"]) -> Float[Tensor, "*batch 4 4"]:
    """`T_b_a` from `T_a_b`, by transposing the rotation."""
    R_inv = T[..., :3, :3].mT
    return from_rotation_translation(R_inv, -(R_inv @ T[..., :3, 3:])[..., 0])


def orthonormalize(T: Float[Tensor, "*batch 4 4"]) -> Float[Tensor, "*batch 4 4"]:
    """The nearest transform with an orthonormal rotation part; a proper rotation if it nearly was one.

    Products of poses drift from SO(3) by rounding. Constant velocity uses each pose twice, which doubles the drift with
    every frame, so poses are orthonormalized as a trajectory grows.
    """
    U, _, Vh = torch.linalg.svd(T[..., :3, :3])
    T = T.clone()
    T[..., :3, :3] = U @ Vh
    return T


def transform(T_target_source: Float[Tensor, "*#batch 4 4"], points: Float[Tensor, "*#batch n 3"]) -> Tensor:
    """Points in the target frame, computed in the dtype and on the device of the points.

    The pose may have another dtype and device: a float64 pose on the CPU transforms float32 points on a GPU.
    """
    T = T_target_source.to(points)
    return points @ T[..., :3, :3].mT + T[..., None, :3, 3]


def transform_map(
    T_target_source: Float[Tensor, "*#batch 4 4"], vertex_map: Float[Tensor, "*#batch 3 h w"]
) -> Float[Tensor, "*batch 3 h w"]:
    """The points of vertex maps in the target frame; empty pixels are transformed like points.

    Written out instead of a matrix product, so that a compiler fuses it and its gradient with the surrounding code.
    """
    x, y, z = vertex_map.unsqueeze(-4).unbind(-3)
    T = T_target_source[..., :3, :, None, None].to(vertex_map)
    return T[..., 0, :, :] * x + T[..., 1, :, :] * y + T[..., 2, :, :] * z + T[..., 3, :, :]


def hat(v: Float[Tensor, "*batch 3"]) -> Float[Tensor, "*batch 3 3"]:
    """The matrix W of the cross product, W w = v x w."""
    eye = torch.eye(3, dtype=v.dtype, device=v.device)
    return torch.linalg.cross(eye.expand(*v.shape, 3), v[..., None, :])


def exp(xi: Float[Tensor, "*batch 6"]) -> Float[Tensor, "*batch 4 4"]:
    """The motion after unit time under the constant twist xi = (translation [m], rotation [rad])."""
    rho, phi = xi[..., :3], xi[..., 3:]
    W = hat(phi)
    W2 = W @ W
    angle, a, b = _sine_and_cosine(phi)
    squared = angle * angle
    small = squared < _SMALL_ANGLE**2
    c = torch.where(small, 1 / 6 - squared / 120, (1 - a) / torch.where(small, 1.0, squared))
    eye = torch.eye(3, dtype=xi.dtype, device=xi.device)
    R = eye + a * W + b * W2
    V = eye + b * W + c * W2
    return from_rotation_translation(R, (V @ rho[..., None])[..., 0])


def log(T: Float[Tensor, "*batch 4 4"]) -> Float[Tensor, "*batch 6"]:
    """The twist (translation [m], rotation [rad]) whose `exp` is T; rotations up to but not including pi."""
    phi = rotation_log(T[..., :3, :3])
    W = hat(phi)
    angle, a, b = _sine_and_cosine(phi)
    squared = angle * angle
    small = squared < _SMALL_ANGLE**2
    d = torch.where(small, 1 / 12 + squared / 720, (1 - a / (2 * b)) / torch.where(small, 1.0, squared))
    V_inv = torch.eye(3, dtype=T.dtype, device=T.device) - W / 2 + d * (W @ W)
    return torch.cat([(V_inv @ T[..., :3, 3:])[..., 0], phi], dim=-1)


def rotation_log(R: Float[Tensor, "*batch 3 3"]) -> Float[Tensor, "*batch 3"]:
    """Rotation vector [rad] of a rotation matrix, accurate for tiny angles where acos of the trace is not."""
    twice_sin_axis = _twice_sine_axis(R)
    sin2 = (twice_sin_axis * twice_sin_axis).sum(-1, keepdim=True) / 4
    cos = (R.diagonal(dim1=-2, dim2=-1).sum(-1, keepdim=True) - 1) / 2
    small = (sin2 < _SMALL_ANGLE**2) & (cos > 0)
    sin = torch.where(small, torch.ones_like(sin2), sin2).sqrt()  # the double where keeps gradients finite
    angle_over_sin = torch.where(small, 1 + sin2 / 6 + 3 * sin2 * sin2 / 40, torch.atan2(sin, cos) / sin)
    return angle_over_sin * twice_sin_axis / 2


def rotation_angle(T: Float[Tensor, "*batch 4 4"]) -> Float[Tensor, "*batch"]:
    """Rotation angle [rad] of a transform, in [0, pi], accurate for tiny angles where acos of the trace is not."""
    R = T[..., :3, :3]
    twice_sine = (R - R.mT).flatten(-2).norm(dim=-1) / 2**0.5
    return torch.atan2(twice_sine, R.diagonal(dim1=-2, dim2=-1).sum(-1) - 1)


@dataclass(frozen=True)
class MotionDifference:
    """How far two motions are apart.

    Args:
        distance_m: length of the translation between them [m].
        angle_deg: angle of the rotation between them [deg].
    """

    distance_m: float
    angle_deg: float


def motion_difference(T_a: Float[Tensor, "4 4"], T_b: Float[Tensor, "4 4"]) -> MotionDifference:
    """Distance and angle of the transform between two poses or motions, float64 on the CPU.

    In numpy, which takes a fraction of torch's time for a single matrix.
    """
    T_a_b = np.linalg.solve(T_a.numpy(), T_b.numpy())
    R, t = T_a_b[:3, :3], T_a_b[:3, 3]
    twice_sine = np.linalg.norm(R - R.T) / math.sqrt(2)
    return MotionDifference(float(np.linalg.norm(t)), math.degrees(math.atan2(twice_sine, np.trace(R) - 1)))


def from_euler(parameters: Float[Tensor, "*batch 6"]) -> Float[Tensor, "*batch 4 4"]:
    """Transform of (x, y, z [m], roll, pitch, yaw [rad]) with R = Rz(yaw) Ry(pitch) Rx(roll).

    Source: Dellenbach et al. 2021, III-B: the six outputs of PoseNet.
    """
    cx, cy, cz = parameters[..., 3:].cos().unbind(-1)
    sx, sy, sz = parameters[..., 3:].sin().unbind(-1)
    rows = [
        [cz * cy, cz * sy * sx - sz * cx, cz * sy * cx + sz * sx],
        [sz * cy, sz * sy * sx + cz * cx, sz * sy * cx - cz * sx],
        [-sy, cy * sx, cy * cx],
    ]
    R = torch.stack([torch.stack(row, dim=-1) for row in rows], dim=-2)
    return from_rotation_translation(R, parameters[..., :3])


def to_euler(T: Float[Tensor, "*batch 4 4"]) -> Float[Tensor, "*batch 6"]:
    """Inverse of `from_euler` for pitch angles within (-pi/2, pi/2)."""
    roll = torch.atan2(T[..., 2, 1], T[..., 2, 2])
    pitch = torch.atan2(-T[..., 2, 0], torch.hypot(T[..., 0, 0], T[..., 1, 0]))
    yaw = torch.atan2(T[..., 1, 0], T[..., 0, 0])
    return torch.cat([T[..., :3, 3], torch.stack([roll, pitch, yaw], dim=-1)], dim=-1)


def relative(T_world: Float[Tensor, "n 4 4"]) -> Float[Tensor, "m 4 4"]:
    """Relative poses `T_i_(i+1)` of consecutive absolute poses `T_world_i`; one fewer than given."""
    return inverse(T_world[:-1]) @ T_world[1:]


def accumulate(T_relative: Float[Tensor, "m 4 4"]) -> Float[Tensor, "n 4 4"]:
    """Absolute poses that start at the identity from consecutive relative poses; one more than given."""
    poses = [torch.eye(4, dtype=T_relative.dtype, device=T_relative.device)]
    for T in T_relative:
        poses.append(poses[-1] @ T)
    return torch.stack(poses)


def _twice_sine_axis(R: Float[Tensor, "*batch 3 3"]) -> Float[Tensor, "*batch 3"]:
    """The axis of a rotation with a length of twice the sine of its angle."""
    twice = R - R.mT
    return torch.stack([twice[..., 2, 1], twice[..., 0, 2], twice[..., 1, 0]], dim=-1)


def _sine_and_cosine(phi: Float[Tensor, "*batch 3"]) -> tuple[Tensor, Tensor, Tensor]:
    """Angle x = |phi|, sin(x)/x and (1 - cos x)/x^2, each of shape (*batch, 1, 1)."""
    x = phi.norm(dim=-1)[..., None, None]
    return x, torch.sinc(x / torch.pi), torch.sinc(x / (2 * torch.pi)).square() / 2
