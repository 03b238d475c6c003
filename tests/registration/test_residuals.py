import pytest
import torch
from torch import Tensor
from torch.nn.functional import normalize

from lidarlearn.geometry import se3
from lidarlearn.registration.residuals import GeneralizedIcp, PointToPlane, PointToPoint, Residual

RESIDUALS = [PointToPlane(), PointToPoint(), GeneralizedIcp(), GeneralizedIcp(epsilon=1e-3)]


def correspondences(batch: tuple[int, ...] = (), n: int = 12) -> dict[str, Tensor]:
    generator = torch.Generator().manual_seed(0)

    def random(*shape: int) -> Tensor:
        return torch.randn(*shape, generator=generator, dtype=torch.float64)

    T = se3.exp(random(*batch, 6))
    points = 10 * random(n, 3)
    map_normals = normalize(random(*batch, n, 3), dim=-1)
    points_world = se3.transform(T, points)
    return {
        "T_world_lidar": T,
        "points": points,
        "points_world": points_world,
        "map_points": points_world + 0.3 * random(*batch, n, 3),
        "map_normals": map_normals,
        "normals": normalize(random(n, 3), dim=-1),
    }


def moved(problem: dict[str, Tensor], xi: Tensor) -> dict[str, Tensor]:
    T = problem["T_world_lidar"] @ se3.exp(xi)
    return {**problem, "T_world_lidar": T, "points_world": se3.transform(T, problem["points"])}


@pytest.mark.parametrize("residual", RESIDUALS[:2])
@pytest.mark.parametrize("batch", [(), (1,), (2, 3)])
def test_jacobians_equal_numerical_differentiation(residual: Residual, batch):
    problem, h = correspondences(batch), 1e-6
    jacobians = residual.linearize(**problem)
    for axis in range(6):
        step = torch.zeros(6, dtype=torch.float64)
        step[axis] = h
        forward = residual.linearize(**moved(problem, step))[..., 6]
        backward = residual.linearize(**moved(problem, -step))[..., 6]
        torch.testing.assert_close(jacobians[..., axis], (forward - backward) / (2 * h), rtol=1e-6, atol=1e-7)


@pytest.mark.parametrize("residual", RESIDUALS[2:])
def test_jacobian_of_generalized_icp_holds_whitening_fixed(residual: Residual):
    """As in Segal et al., covariances are those of the current pose; residuals are then linear."""
    problem, h = correspondences(), 1e-6
    linear = residual.linearize(**problem)
    for axis in range(6):
        step = torch.zeros(6, dtype=torch.float64)
        step[axis] = h
        offset = moved(problem, step)["points_world"] - moved(problem, -step)["points_world"]
        whitened_units = []
        for unit in torch.eye(3, dtype=torch.float64):
            shifted = {**problem, "map_points": problem["points_world"] - unit}
            whitened_units.append(residual.linearize(**shifted)[..., 6])
        whitening = torch.stack(whitened_units, dim=-1)
        numerical = (whitening @ offset[..., None])[..., 0] / (2 * h)
        torch.testing.assert_close(linear[..., axis], numerical, rtol=1e-6, atol=1e-7)


def test_point_to_plane_is_signed_distance():
    problem = correspondences()
    problem["map_points"] = problem["points_world"] - 0.25 * problem["map_normals"]
    residuals = PointToPlane().linearize(**problem)[..., 6]
    torch.testing.assert_close(residuals, torch.full_like(residuals, 0.25))


def test_point_to_plane_ignores_offsets_along_plane():
    problem = correspondences()
    along = torch.linalg.cross(problem["map_normals"], torch.tensor([0.3, -0.8, 0.5]).double().expand(12, 3))
    problem["map_points"] = problem["points_world"] + along
    assert PointToPlane().linearize(**problem)[..., 6].abs().max() < 1e-12


def test_point_to_plane_without_normal_is_zero():
    problem = correspondences()
    problem["map_normals"] = torch.zeros_like(problem["map_normals"])
    assert not PointToPlane().linearize(**problem).any()


def test_generalized_icp_is_mahalanobis_distance():
    problem, epsilon = correspondences(), 1e-2
    residuals = GeneralizedIcp(epsilon).linearize(**problem)[..., 6]
    R = problem["T_world_lidar"][:3, :3]
    for i in range(12):
        covariance = torch.zeros(3, 3, dtype=torch.float64)
        for n in (problem["map_normals"][i], R @ problem["normals"][i]):
            covariance += torch.eye(3) - (1 - epsilon) * torch.outer(n, n)
        d = problem["points_world"][i] - problem["map_points"][i]
        expected = 2 * epsilon * d @ torch.linalg.solve(covariance, d)
        assert residuals[i].square().sum().item() == pytest.approx(expected.item(), rel=1e-9)


@pytest.mark.parametrize("share", [1.0, 0.0])
def test_generalized_icp_of_parallel_planes_is_point_to_plane(share: float):
    """A point without a normal is taken to lie on the surface that it is matched with."""
    problem = correspondences()
    problem["normals"] = share * problem["map_normals"] @ problem["T_world_lidar"][:3, :3]
    size = GeneralizedIcp(1e-6).linearize(**problem)[..., 6].norm(dim=-1)
    plane = PointToPlane().linearize(**problem)[..., 6][:, 0].abs()
    torch.testing.assert_close(size, plane, rtol=1e-3, atol=1e-3)


def test_generalized_icp_without_normals_is_refused():
    with pytest.raises(ValueError, match="normals of the new scan"):
        GeneralizedIcp().linearize(**{**correspondences(), "normals": None})
