"""Skewed scans: how much of the skew is estimated, and how much of it remains in the pose."""

import math

import numpy as np
import pytest
import torch
from torch import Tensor

from lidarlearn.geometry import se3
from lidarlearn.odometry.deskew import deskew
from lidarlearn.registration.elasticity import Elasticity
from lidarlearn.registration.gauss_newton import GaussNewton
from lidarlearn.registration.matching import Matching, Queries
from lidarlearn.registration.normal_equations import NormalEquations
from lidarlearn.registration.residuals import GeneralizedIcp, PointToPlane, PointToPoint
from lidarlearn.registration.result import RegistrationResult
from lidarlearn.registration.weights import GemanMcClure
from tests.registration import maps

SKEW = torch.tensor([0.09, -0.02, 0.01, 0.001, -0.002, 0.003], dtype=torch.float64)  # as between two scans of KITTI
all_associations = pytest.mark.parametrize("association", maps.ASSOCIATIONS)
all_residuals = pytest.mark.parametrize(
    "residual", [PointToPlane(), PointToPoint(), GeneralizedIcp()], ids=lambda r: type(r).__name__
)


def phases_of(points: Tensor) -> Tensor:
    return torch.atan2(points[:, 1], points[:, 0]) / (-2 * math.pi)


def register(
    scene: maps.Scene, skew: Tensor, elasticity: Elasticity | None, T_start: Tensor | None = None, **settings: int
) -> RegistrationResult:
    """Register points that fit the map but for the skew."""
    phases = phases_of(scene.queries)
    skewed = deskew(scene.queries, phases, se3.exp(-skew))
    T_start = scene.T_world_lidar if T_start is None else T_start
    return GaussNewton(elasticity=elasticity, **settings).register(
        skewed, scene.association, T_start, 1.0, None, phases
    )


def equations_of(residual: PointToPlane | PointToPoint | GeneralizedIcp, T: Tensor) -> NormalEquations:
    scene = maps.scene("room", "kd")
    normals = scene.normals if residual.needs_normals else None
    matching = Matching(residual, GemanMcClure(), 0.5, scene.association)
    return matching.equations(Queries(scene.queries, normals), T.numpy(), 0.5)


@all_associations
@pytest.mark.parametrize("name", ["room", "street"])
def test_elasticity_finds_skew_and_corrects_pose(association, name):
    scene = maps.scene(name, association)
    elastic, rigid = register(scene, SKEW, Elasticity()), register(scene, SKEW, None)
    assert (elastic.skew - SKEW)[:3].norm() < 0.6 * SKEW[:3].norm()
    errors = [maps.errors(result.T_world_lidar, scene.T_world_lidar)[0] for result in (elastic, rigid)]
    assert errors[0] < 0.9 * errors[1]
    assert not rigid.skew.any()


@all_associations
def test_scan_without_skew_is_hardly_bent(association):
    scene = maps.scene("street", association)
    result = register(scene, torch.zeros(6, dtype=torch.float64), Elasticity())
    assert result.skew[:3].norm() < 0.015 and result.skew[3:].norm() < math.radians(0.1)


def test_skew_shrinks_with_points_per_measurement():
    scene = maps.scene("room", "kd")
    sizes = [
        register(scene, SKEW, Elasticity(0.05, 0.1, points)).skew[:3].norm().item() for points in (1.0, 1e2, 1e4, 1e8)
    ]
    assert sizes == sorted(sizes, reverse=True)
    assert sizes[0] > 0.06 and sizes[-1] < 1e-4


@all_residuals
@pytest.mark.parametrize("batch", [(), (2,)])
def test_elastic_step_equals_joint_least_squares(residual, batch):
    """All twelve unknowns at once; the prior adds six rows."""
    scene = maps.scene("room", "kd")
    T = (
        scene.T_world_lidar @ se3.exp(torch.tensor([0.05, -0.03, 0.02, 0.003, 0.002, -0.004], dtype=torch.float64))
    ).expand(*batch, 4, 4)
    rigid, phases, elasticity = equations_of(residual, T), phases_of(scene.queries), Elasticity(0.04, 0.2, 5.0)
    elastic = elasticity.equations(rigid, phases)
    step = -np.linalg.solve(elastic.pose.H, elastic.pose.g[..., None])[..., 0]
    found = np.concatenate([step, elastic.skew(step)], axis=-1)

    rows = rigid.terms.augmented_jacobians
    rows = rows.double().reshape(-1, *rows.shape[-3:])[0]
    weights = rigid.terms.weights.double().reshape(-1, len(rows))[0]
    J, r = rows[..., :6], rows[..., 6]
    both = torch.cat([J, J * phases.double()[:, None, None]], dim=-1) * weights.sqrt()[:, None, None]
    residuals = r * weights.sqrt()[:, None]
    count = (weights[:, None, None] * J[..., :3].square()).sum()  # of unit directions that are measured
    noise = 5.0 * (residuals.square().sum() / count + 1e-6)
    expected = torch.tensor([0.04] * 3 + [math.radians(0.2)] * 3, dtype=torch.float64)
    held = torch.cat([torch.zeros(6, 6, dtype=torch.float64), (noise.sqrt() / expected).diag()], dim=1)
    A = torch.cat([both.flatten(0, 1), held])
    b = torch.cat([-residuals.flatten(), torch.zeros(6, dtype=torch.float64)])
    slow = torch.linalg.lstsq(A, b[:, None]).solution[:, 0]
    np.testing.assert_allclose(found.reshape(-1, 12)[0], slow.numpy(), rtol=1e-3, atol=1e-6)


@all_associations
def test_skew_is_zero_without_correspondences(association):
    scene = maps.scene("room", association)
    away = scene.T_world_lidar @ se3.exp(torch.tensor([0, 0, 400.0, 0, 0, 0], dtype=torch.float64))
    result = register(scene, SKEW, Elasticity(), away, max_iterations=3)
    torch.testing.assert_close(result.T_world_lidar, away, rtol=0, atol=1e-9)
    assert not result.skew.any() and not result.converged


@pytest.mark.parametrize("association", ["kd", "vh"])
@pytest.mark.parametrize("name", ["corridor", "tunnel"])
def test_skew_stays_small_along_degenerate_direction(association, name):
    """No skew explains that a scan stays behind in an endless corridor."""
    scene = maps.scene(name, association)
    behind = scene.T_world_lidar @ se3.exp(torch.tensor([0.3, 0, 0, 0, 0, 0], dtype=torch.float64))
    gauss_newton = GaussNewton(min_information=0.01)
    result = gauss_newton.register(scene.queries, scene.association, behind, 1.0, phases=phases_of(scene.queries))
    assert (se3.inverse(scene.T_world_lidar) @ result.T_world_lidar)[0, 3].item() == pytest.approx(0.3, abs=0.06)
    assert result.skew[:3].norm() < 0.05


@pytest.mark.parametrize("setting", ["translation_m", "rotation_deg", "points_per_measurement"])
def test_prior_of_zero_is_refused(setting):
    with pytest.raises(ValueError, match=f"{setting}=0.*elasticity=null"):
        Elasticity(**{setting: 0.0})
