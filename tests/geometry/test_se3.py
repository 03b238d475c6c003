"""Rigid motions: axioms of a Lie group over batch shapes; scipy and the matrix exponential as oracles."""

import math

import pytest
import torch
from scipy.spatial.transform import Rotation
from torch import Tensor

from lidarlearn.geometry import se3

BATCHES = [(), (1,), (3, 1, 2)]
ANGLES = [0.0, 1e-12, 1e-7, 1e-4, 0.0099, 0.0101, 0.5, 2.0, 3.1]  # series below 0.01 rad


def random_twists(*batch: int, angle: float | None = None, seed: int = 0) -> Tensor:
    generator = torch.Generator().manual_seed(seed)
    xi = torch.randn(*batch, 6, generator=generator, dtype=torch.float64)
    if angle is not None:
        xi[..., 3:] *= angle / xi[..., 3:].norm(dim=-1, keepdim=True)
    return xi


def hat6(xi: Tensor) -> Tensor:
    matrix = xi.new_zeros(*xi.shape[:-1], 4, 4)
    matrix[..., :3, :3], matrix[..., :3, 3] = se3.hat(xi[..., 3:]), xi[..., :3]
    return matrix


def assert_close(actual: Tensor, expected: Tensor, atol: float = 1e-12) -> None:
    torch.testing.assert_close(actual, expected, rtol=0, atol=atol)


@pytest.mark.parametrize("batch", BATCHES)
def test_group_axioms(batch):
    A, B, C = (se3.exp(random_twists(*batch, seed=seed)) for seed in range(3))
    one = se3.identity(*batch)
    assert_close(A @ one, A)
    assert_close(A @ se3.inverse(A), one)
    assert_close(se3.inverse(A) @ A, one)
    assert_close((A @ B) @ C, A @ (B @ C))
    assert_close(se3.inverse(A @ B), se3.inverse(B) @ se3.inverse(A))


@pytest.mark.parametrize("batch", BATCHES)
@pytest.mark.parametrize("angle", ANGLES)
def test_exp_equals_matrix_exponential(batch, angle):
    xi = random_twists(*batch, angle=angle)
    assert_close(se3.exp(xi), torch.linalg.matrix_exp(hat6(xi)))


@pytest.mark.parametrize("batch", BATCHES)
@pytest.mark.parametrize("angle", ANGLES)
def test_log_inverts_exp(batch, angle):
    xi = random_twists(*batch, angle=angle)
    assert_close(se3.log(se3.exp(xi)), xi, atol=1e-11)


def test_log_of_tiny_rotations_in_single_precision():
    xi = random_twists(50, angle=1e-4).float()
    torch.testing.assert_close(se3.log(se3.exp(xi))[:, 3:], xi[:, 3:], rtol=1e-4, atol=1e-9)


@pytest.mark.parametrize("angle", ANGLES)
def test_rotations_equal_scipy(angle):
    phi = random_twists(20, angle=angle)[:, 3:]
    R = torch.from_numpy(Rotation.from_rotvec(phi.numpy()).as_matrix())
    assert_close(se3.exp(torch.cat([torch.zeros_like(phi), phi], dim=1))[:, :3, :3], R)
    assert_close(se3.rotation_log(R), torch.from_numpy(Rotation.from_matrix(R.numpy()).as_rotvec()), atol=1e-11)
    T = se3.from_rotation_translation(R, torch.ones_like(phi))
    assert_close(se3.rotation_angle(T), torch.full((20,), angle, dtype=torch.float64), atol=1e-11)


@pytest.mark.parametrize("batch", BATCHES)
def test_conjugation_transforms_twist_by_adjoint(batch):
    T, xi = se3.exp(random_twists(*batch)), random_twists(*batch, angle=0.3, seed=1)
    moved = se3.log(T @ se3.exp(xi) @ se3.inverse(T))
    R, t = T[..., :3, :3], T[..., :3, 3]
    rotation = (R @ xi[..., 3:, None])[..., 0]
    translation = (R @ xi[..., :3, None])[..., 0] + torch.linalg.cross(t, rotation)
    assert_close(moved, torch.cat([translation, rotation], dim=-1), atol=1e-11)


def test_motions_along_one_twist_add_up():
    xi = random_twists(5, angle=0.8)
    assert_close(se3.exp(0.3 * xi) @ se3.exp(0.7 * xi), se3.exp(xi))


@pytest.mark.parametrize("batch", BATCHES)
def test_transform_is_homogeneous_product(batch):
    T = se3.exp(random_twists(*batch))
    points = torch.randn(*batch, 7, 3, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    homogeneous = torch.cat([points, torch.ones_like(points[..., :1])], dim=-1)
    assert_close(se3.transform(T, points), (T[..., None, :, :] @ homogeneous[..., None])[..., :3, 0])
    assert se3.transform(T, points.float()).dtype == torch.float32


def test_hat_is_cross_product():
    v, w = random_twists(9)[:, :3], random_twists(9, seed=1)[:, :3]
    assert_close((se3.hat(v) @ w[..., None])[..., 0], torch.linalg.cross(v, w))


def test_euler_angles_are_rz_ry_rx():
    parameters = random_twists(20, angle=1.0)
    oracle = Rotation.from_euler("ZYX", parameters[:, [5, 4, 3]].numpy()).as_matrix()  # intrinsic: Rz Ry Rx
    T = se3.from_euler(parameters)
    assert_close(T[:, :3, :3], torch.from_numpy(oracle))
    assert_close(T[:, :3, 3], parameters[:, :3])


@pytest.mark.parametrize("batch", BATCHES)
def test_euler_angles_round_trip(batch):
    parameters = random_twists(*batch, angle=1.2)
    assert_close(se3.to_euler(se3.from_euler(parameters)), parameters)


def test_euler_angles_are_tangent_to_exp_at_identity():
    xi = 1e-6 * random_twists(10)
    assert_close(se3.from_euler(xi), se3.exp(xi), atol=1e-11)


def test_orthonormalize_finds_nearest_rotation():
    T = se3.exp(random_twists(10))
    bent = T.clone()
    bent[:, :3, :3] += 1e-3 * random_twists(10, 3, seed=1)[..., :3]
    mended = se3.orthonormalize(bent)
    R = mended[:, :3, :3]
    assert_close(R @ R.mT, torch.eye(3, dtype=torch.float64).expand(10, 3, 3))
    assert (torch.linalg.det(R) > 0).all()
    assert ((R - bent[:, :3, :3]).norm(dim=(1, 2)) <= (T - bent)[:, :3, :3].norm(dim=(1, 2))).all()
    assert_close(se3.orthonormalize(T), T)


def test_accumulate_inverts_relative():
    steps = se3.exp(0.1 * random_twists(30))
    world = se3.accumulate(steps)
    assert torch.equal(world[0], se3.identity())
    assert_close(se3.relative(world), steps)
    assert se3.relative(world[:1]).shape == (0, 4, 4)


@pytest.mark.parametrize("function", [se3.exp, lambda xi: se3.log(se3.exp(xi)), se3.from_euler])
@pytest.mark.parametrize("scale", [0.0, 1e-9, 1e-3, 0.7])
def test_gradients(function, scale):
    xi = (scale * random_twists(3)).requires_grad_()
    assert torch.autograd.gradcheck(function, (xi,), atol=1e-7)


@pytest.mark.parametrize("scale", [0.0, 1e-9, 1e-3, 0.7])
def test_gradient_of_log_with_respect_to_motion(scale):
    """The matrix is only moved within the group."""
    T, zero = se3.exp(scale * random_twists(3)), torch.zeros(3, 6, dtype=torch.float64, requires_grad=True)
    assert torch.autograd.gradcheck(lambda d: se3.log(T @ se3.exp(d)), (zero,), atol=1e-7)


def test_gradient_of_log_is_finite_at_identity():
    T = se3.identity(2).requires_grad_()
    se3.log(T).sum().backward()
    assert torch.isfinite(T.grad).all()


def test_log_is_accurate_up_to_half_turns():
    xi = random_twists(8, angle=math.pi - 1e-5)
    assert_close(se3.log(se3.exp(xi)), xi, atol=1e-8)


@pytest.mark.parametrize("batch", BATCHES)
def test_transform_map_equals_transform_of_points(batch):
    T = se3.exp(random_twists(*batch))
    maps = torch.randn(*batch, 3, 4, 6, generator=torch.Generator().manual_seed(1), dtype=torch.float64)
    assert_close(se3.transform_map(T, maps).flatten(-2), se3.transform(T, maps.flatten(-2).mT).mT)


def test_motion_difference_measures_motion_between():
    T_a = se3.exp(torch.tensor([1.2, 0.1, 0.0, 0.01, -0.02, 0.3], dtype=torch.float64))
    T_a_b = se3.exp(torch.tensor([0.3, 0.0, 0.4, 0.0, 0.0, math.radians(5)], dtype=torch.float64))
    difference = se3.motion_difference(T_a, T_a @ T_a_b)
    assert difference.distance_m == pytest.approx(T_a_b[:3, 3].norm().item())
    assert difference.angle_deg == pytest.approx(5.0)
