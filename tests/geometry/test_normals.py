import math

import pytest
import torch
from torch import Tensor

from lidarlearn.geometry import se3
from lidarlearn.geometry.normals import fit_planes, normal_map
from lidarlearn.geometry.projection import SphericalProjection, activated

IMAGE = SphericalProjection()


def rays(projection: SphericalProjection = IMAGE) -> Tensor:
    """Unit directions of the pixel centres (3, h, w), float64."""
    row = torch.arange(projection.height, dtype=torch.float64)
    column = torch.arange(projection.width, dtype=torch.float64)
    span = projection.fov_up_deg - projection.fov_down_deg
    e = (projection.fov_up_deg - (row + 0.5) / projection.height * span).deg2rad()[:, None]
    a = (math.pi * (1 - (column + 0.5) / projection.width * 2))[None]
    return torch.stack([e.cos() * a.cos(), e.cos() * a.sin(), e.sin().expand(-1, len(column))])


def on_plane(normal: Tensor, distance: float, max_range: float = 80.0) -> Tensor:
    """Vertex map of the plane normal . p = -distance, seen from the origin."""
    directions = rays()
    cosine = torch.einsum("i,ihw->hw", normal, directions)
    ranges = -distance / cosine
    ranges = torch.where((ranges > 0) & (ranges < max_range), ranges, 0.0)
    return (ranges * directions).float()


def angles_deg(normals: Tensor, true: Tensor) -> Tensor:
    """Angles of the defined normals against one direction; by the chord, which is exact for tiny ones."""
    defined = normals.movedim(-3, -1)[(normals != 0).any(dim=-3)]
    return 2 * ((defined.double() - true).norm(dim=1) / 2).asin().rad2deg()


PLANES = [
    ([0.0, 0.0, 1.0], 1.73),
    ([0.0, 1.0, 0.0], 6.0),
    ([0.6, 0.8, 0.0], 12.0),
    ([0.1, -0.2, 0.97], 1.5),
    ([0.0, 0.0, 1.0], 0.4),
]


@pytest.mark.parametrize(("normal", "distance"), PLANES)
def test_normals_of_noise_free_plane_are_exact(normal, distance):
    true = torch.nn.functional.normalize(torch.tensor(normal, dtype=torch.float64), dim=0)
    normals = normal_map(on_plane(true, distance))
    errors = angles_deg(normals, true)
    assert len(errors) > 3000
    assert errors.median() < 0.002 and errors.max() < 0.1


@pytest.mark.parametrize(("normal", "distance"), PLANES)
def test_most_pixels_of_plane_have_normals(normal, distance):
    vertices = on_plane(torch.nn.functional.normalize(torch.tensor(normal, dtype=torch.float64), dim=0), distance)
    shares = (normal_map(vertices) != 0).any(dim=0).sum() / activated(vertices).sum()
    assert shares > 0.8


def test_normals_are_unit_at_activated_pixels_or_zero():
    vertices = on_plane(torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64), 1.73)
    vertices = vertices * (torch.rand(64, 720, generator=torch.Generator().manual_seed(0)) < 0.6)
    normals = normal_map(vertices)
    length = normals.norm(dim=0)
    assert ((length - 1).abs() < 1e-5).logical_or(length == 0).all()
    assert not (length[~activated(vertices)] > 0).any()


def test_normals_do_not_mix_sides_of_depth_jump():
    """A wall at 5 m in front of one at 9 m."""
    forward = torch.tensor([-1.0, 0.0, 0.0], dtype=torch.float64)
    vertices = on_plane(forward, 9.0)
    vertices[:, :, 300:361] = on_plane(forward, 5.0)[:, :, 300:361]
    errors = angles_deg(normal_map(vertices), forward)
    assert len(errors) > 1000 and errors.max() < 0.1


def test_pixel_isolated_in_depth_has_no_normal():
    vertices = on_plane(torch.tensor([-1.0, 0.0, 0.0], dtype=torch.float64), 9.0)
    vertices[:, 30, 360] *= 0.5
    normals = normal_map(vertices)
    assert not normals[:, 30, 360].any() and normals[:, 30, 364].any()


def test_single_row_or_column_has_no_normals():
    vertices = on_plane(torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64), 1.73)
    row, column = torch.zeros_like(vertices), torch.zeros_like(vertices)
    row[:, 40], column[:, :, 100] = vertices[:, 40], vertices[:, :, 100]
    assert not normal_map(row).any() and not normal_map(column).any()


def test_two_rows_have_normals():
    vertices = on_plane(torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64), 1.73)
    vertices[:, :40] = 0
    vertices[:, 42:] = 0
    normals = normal_map(vertices)
    assert normals[:, 40:42].any() and angles_deg(normals, torch.tensor([0, 0, 1.0])).max() < 0.1


@pytest.mark.parametrize(
    ("neighbours", "is_enough"),
    [
        ([(0, -1), (0, 1), (-1, 0), (1, 0)], True),
        ([(-1, -1), (-1, 1), (0, 1)], False),  # three
        ([(0, -2), (0, -1), (0, 1), (0, 2), (-1, 0)], False),  # one in another row
        ([(-2, 0), (-1, 0), (1, 0), (2, 0), (0, -1)], False),  # or column
    ],
)
def test_normal_needs_four_neighbours_in_other_rows_and_columns(neighbours, is_enough):
    floor = on_plane(torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64), 1.73)
    vertices = torch.zeros_like(floor)
    for row, column in ((0, 0), *neighbours):
        vertices[:, 40 + row, 360 + column] = floor[:, 40 + row, 360 + column]
    assert normal_map(vertices, window=(5, 5))[:, 40, 360].any() == is_enough


def test_rough_patches_have_no_normals():
    wall = on_plane(torch.tensor([-1.0, 0.0, 0.0], dtype=torch.float64), 9.0)
    rough = wall * (1 + 0.04 * (-1.0) ** torch.arange(720))  # every second column is farther away
    strict, generous = (activated(normal_map(rough, max_roughness=r)).sum() for r in (0.2, 10.0))
    assert strict < 0.05 * generous


def test_neighbours_wrap_at_seam():
    vertices = on_plane(torch.tensor([1.0, 0.0, 0.0], dtype=torch.float64), 8.0)  # a wall behind the sensor
    rolled = normal_map(vertices.roll(360, dims=2)).roll(-360, dims=2)
    torch.testing.assert_close(normal_map(vertices), rolled)
    assert normal_map(vertices)[:, 40, [0, -1]].any(dim=0).all()


def test_neighbours_do_not_wrap_across_rows():
    vertices = on_plane(torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64), 1.73)
    only_top_and_bottom = torch.zeros_like(vertices)
    only_top_and_bottom[:, 63] = vertices[:, 63]
    only_top_and_bottom[:, 0] = vertices[:, 63]
    assert not normal_map(only_top_and_bottom).any()


def test_normals_are_exact_at_long_range():
    true = torch.tensor([-1.0, 0.0, 0.0], dtype=torch.float64)
    errors = angles_deg(normal_map(on_plane(true, 75.0)), true)
    assert len(errors) > 100 and errors.max() < 0.02


def test_batch_equals_single_maps():
    vertices = torch.stack([on_plane(torch.tensor(n, dtype=torch.float64), d) for n, d in PLANES[:3]])
    normals = normal_map(vertices[None])
    assert normals.shape == (1, 3, 3, 64, 720)
    assert torch.equal(normals[0, 1], normal_map(vertices[1]))


def test_noise_does_not_bias_normals():
    noisy = on_plane(torch.tensor([-1.0, 0.0, 0.0], dtype=torch.float64), 20.0)
    generator = torch.Generator().manual_seed(0)
    noisy = noisy * (1 + 0.0005 * torch.randn(64, 720, generator=generator))
    normals = normal_map(noisy)
    defined = normals[:, (normals != 0).any(dim=0)].T
    assert defined.mean(dim=0)[1:].abs().max() < 0.01
    assert angles_deg(normals, torch.tensor([-1.0, 0, 0])).median() < 3.0


def random_covariances(n: int, eigenvalues: list[float], dtype: torch.dtype) -> tuple[Tensor, Tensor]:
    """Components, and the matrices themselves, of covariances with given eigenvalues."""
    xi = torch.randn(n, 6, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    R = se3.exp(xi)[:, :3, :3]
    matrices = ((R * torch.tensor(eigenvalues, dtype=torch.float64)) @ R.mT).to(dtype)
    return matrices.flatten(1)[:, [0, 1, 2, 4, 5, 8]], matrices


@pytest.mark.parametrize("eigenvalues", [[0.0, 1, 1], [0.001, 1, 3], [1e-8, 1e-4, 2e-3], [0.2, 1, 5], [1e2, 1e4, 3e4]])
def test_fit_planes_equals_eigensolver(eigenvalues):
    components, matrices = random_covariances(200, eigenvalues, torch.float64)
    plane = fit_planes(components)
    oracle = torch.linalg.eigh(matrices)
    ratio = (eigenvalues[0] / eigenvalues[1]) ** 8
    cosines = (plane.normals * oracle.eigenvectors[..., 0]).sum(-1).abs()
    assert (1 - cosines).max() < 1e-9 + ratio
    scale = eigenvalues[-1]
    torch.testing.assert_close(plane.variances / scale, oracle.eigenvalues / scale, rtol=0, atol=1e-6)


def test_fit_planes_in_single_precision():
    components, matrices = random_covariances(500, [1e-4, 0.04, 0.1], torch.float32)
    normals = torch.linalg.eigh(matrices.double()).eigenvectors[..., 0]
    cosines = (fit_planes(components).normals * normals).sum(-1).abs()
    assert cosines.min() > 1 - 1e-5


@pytest.mark.parametrize("components", [[0.0] * 6, [1.0, 0, 0, 0, 0, 0], [1.0, 0, 0, 1.0, 0, 1.0]])
def test_fit_planes_is_finite_without_plane(components):
    plane = fit_planes(torch.tensor([components]))
    assert torch.isfinite(plane.normals).all() and torch.isfinite(plane.variances).all()
