"""Registration on simulated scenes: basin of convergence, degenerate directions, missing correspondences."""

import math

import pytest
import torch
from torch import Tensor

from lidarlearn.geometry import se3
from lidarlearn.registration.association.base import Association, Correspondences, Neighbours
from lidarlearn.registration.gauss_newton import GaussNewton
from lidarlearn.registration.residuals import GeneralizedIcp, PointToPlane, PointToPoint
from lidarlearn.registration.result import RegistrationResult
from lidarlearn.registration.weights import Cauchy, CutOff, GemanMcClure, Huber, NoWeight, Proximity
from tests.registration import maps

WIDE_M = 3.0
KERNELS = [NoWeight(), Proximity(), Huber(), CutOff(), GemanMcClure(), Cauchy()]
all_kernels = pytest.mark.parametrize("kernel", KERNELS, ids=lambda k: type(k).__name__)
all_associations = pytest.mark.parametrize("association", maps.ASSOCIATIONS)
all_scenes = pytest.mark.parametrize("name", ["room", "street"])


def solver(association: str, **settings) -> GaussNewton:
    """As configured for the association, but with enough iterations to converge from afar."""
    return GaussNewton(**{"search_distance_m": 0.4 if association == "vh" else 0.5, "max_iterations": 60, **settings})


def register(gauss_newton: GaussNewton, scene: maps.Scene, perturbation: Tensor) -> RegistrationResult:
    normals = scene.normals if gauss_newton.residual.needs_normals else None
    T_start = scene.T_world_lidar @ se3.exp(perturbation)
    return gauss_newton.register(scene.queries, scene.association, T_start, WIDE_M, normals)


def assert_all_converge(result: RegistrationResult, scene: maps.Scene, grid: Tensor) -> None:
    distances, angles = maps.errors(result.T_world_lidar, scene.T_world_lidar)
    missed = (distances > 0.03) | (angles > 0.15)
    assert not missed.any(), (
        f"from {grid[missed].tolist()}: {distances[missed].tolist()} m, {angles[missed].tolist()} deg"
    )
    assert result.converged.all()


@all_scenes
@all_associations
def test_basin_with_default_kernel(name, association):
    scene, grid = maps.scene(name, association), maps.planar_grid()[::3]
    assert_all_converge(register(solver(association), scene, grid), scene, grid)


@pytest.mark.slow
@all_scenes
@all_associations
@all_kernels
def test_whole_basin_in_plane(name, association, kernel):
    scene, grid = maps.scene(name, association), maps.planar_grid()
    assert_all_converge(register(solver(association, weight=kernel), scene, grid), scene, grid)


@pytest.mark.slow
@all_scenes
@pytest.mark.parametrize("association", ["kd", "vh"])
@all_kernels
def test_whole_basin_along_vertical(name, association, kernel):
    """Projective association only compares points of one elevation, so it finds no partners at a vertical offset."""
    scene, grid = maps.scene(name, association), maps.vertical_grid()
    assert_all_converge(register(solver(association, weight=kernel), scene, grid), scene, grid)


@all_associations
def test_generalized_icp_converges(association):
    scene, grid = maps.scene("street", association), 0.6 * maps.planar_grid()[::5]
    gauss_newton = solver(association, residual=GeneralizedIcp(), weight=Proximity())
    assert_all_converge(register(gauss_newton, scene, grid), scene, grid)


@pytest.mark.parametrize("association", ["kd", "vh"])
@all_scenes
def test_point_to_point_converges(name, association):
    """Slower and less exact than the others, as the points of two scans never coincide."""
    scene, grid = maps.scene(name, association), 0.3 * maps.planar_grid()[::5]
    gauss_newton = solver(association, residual=PointToPoint(), weight=Proximity(), max_iterations=120)
    result = register(gauss_newton, scene, grid)
    distances, angles = maps.errors(result.T_world_lidar, scene.T_world_lidar)
    assert distances.max() < 0.06 and angles.max() < 0.3


@all_associations
def test_batch_equals_single_registrations(association):
    scene, grid = maps.scene("room", association), 0.3 * maps.planar_grid()[[2, 14]]
    gauss_newton = solver(association, translation_tolerance_m=1e-5, rotation_tolerance_deg=1e-4)
    batch = register(gauss_newton, scene, grid.view(1, 2, 6))
    assert batch.T_world_lidar.shape == (1, 2, 4, 4) and batch.converged.shape == (1, 2)
    assert batch.hessian.shape == (1, 2, 6, 6) and batch.weakest_direction.shape == (1, 2, 3)
    for i, perturbation in enumerate(grid):
        single = register(gauss_newton, scene, perturbation)
        T = batch.T_world_lidar[0, i]
        distance, angle = maps.errors(T, single.T_world_lidar)
        assert distance < 2e-4 and angle < 2e-3
        for name in ("overlap", "inlier_share", "fit"):
            assert getattr(batch, name)[0, i].item() == pytest.approx(getattr(single, name).item(), abs=0.01)


@all_associations
def test_map_out_of_reach_leaves_initial_pose(association):
    scene = maps.scene("room", association)
    T_start = scene.T_world_lidar @ se3.exp(torch.tensor([0, 0, 400.0, 0, 0, 0], dtype=torch.float64))
    result = solver(association, max_iterations=3).register(scene.queries, scene.association, T_start, WIDE_M)
    assert_unregistered(result, T_start)


@all_associations
def test_empty_map_leaves_initial_pose(association):
    _, empty = maps.make(association)
    T_start = se3.exp(torch.tensor([1.0, 2, 3, 0.1, 0.2, 0.3], dtype=torch.float64))
    queries = maps.scene("room", association).queries
    result = solver(association, max_iterations=3).register(queries, empty, T_start, WIDE_M)
    assert_unregistered(result, T_start)


@all_associations
@pytest.mark.parametrize("batch", [(), (3,), (0,)])
def test_empty_scan_leaves_initial_pose(association, batch):
    scene = maps.scene("room", association)
    T_start = se3.identity(*batch)
    result = solver(association, max_iterations=3).register(torch.zeros(0, 3), scene.association, T_start, WIDE_M)
    assert_unregistered(result, T_start)


def assert_unregistered(result: RegistrationResult, T_start: Tensor) -> None:
    torch.testing.assert_close(result.T_world_lidar, T_start, rtol=0, atol=1e-9)
    assert not result.converged.any() and not result.overlap.any() and not result.fit.any()
    for value in (result.rmse_m, result.hessian, result.information, result.inlier_share, result.weakest_direction):
        assert torch.isfinite(value).all()
    assert not result.information.any()


@all_associations
@pytest.mark.parametrize("name", ["corridor", "tunnel"])
def test_position_is_held_along_degenerate_direction(association, name):
    """Along an endless corridor; across it, the scan is registered."""
    scene, offsets = maps.scene(name, association), torch.tensor([-0.8, 0.5], dtype=torch.float64)
    perturbation = torch.tensor([0, 0.2, 0.1, 0, 0, 0.03], dtype=torch.float64).repeat(2, 1)
    perturbation[:, 0] = offsets
    result = register(solver(association, min_information=0.01), scene, perturbation)
    error = se3.inverse(scene.T_world_lidar) @ result.T_world_lidar
    torch.testing.assert_close(error[:, 0, 3], offsets, rtol=0, atol=0.06)
    assert error[:, 1:3, 3].norm(dim=1).max() < 0.03 and se3.rotation_angle(error).rad2deg().max() < 0.15
    assert result.information[:, 0].max() < 0.01 < result.information[:, 1].min()
    assert result.weakest_direction[:, 0].abs().min() > 0.999


@all_associations
@all_scenes
def test_room_and_street_are_not_degenerate(association, name):
    scene = maps.scene(name, association)
    result = register(solver(association), scene, torch.zeros(6, dtype=torch.float64))
    assert result.information.min() > 0.03
    assert (result.information.diff() >= 0).all()


@pytest.mark.parametrize("residual", [PointToPlane(), PointToPoint(), GeneralizedIcp()], ids=lambda r: type(r).__name__)
def test_result_of_converged_registration(residual):
    scene = maps.scene("room", "kd")
    result = register(solver("kd", residual=residual), scene, torch.zeros(6, dtype=torch.float64))
    assert result.converged and 0 < result.iterations < 60
    assert 0.8 < result.overlap <= 1 and 0 < result.fit <= result.overlap
    assert (0.6 if isinstance(residual, PointToPoint) else 0.9) < result.inlier_share <= 1
    assert 0.005 < result.rmse_m < 0.25
    torch.testing.assert_close(result.hessian, result.hessian.mT, rtol=1e-4, atol=1e-2)
    assert torch.linalg.eigvalsh(result.hessian).min() > 0


ON_PLANE = 5 * torch.randn(500, 3, generator=torch.Generator().manual_seed(0)) * torch.tensor([1.0, 1.0, 0.0])


class _Plane(Association):
    """The endless plane z = 0: a neighbour for every point, straight below it or beside the foot."""

    def __init__(self, beside_m: float = 0.0) -> None:
        self.beside_m = beside_m

    def insert(self, points, T_world_lidar, frames) -> None:
        raise AssertionError("nothing to insert")

    def clear(self) -> None:
        raise AssertionError("nothing to clear")

    points = normals = torch.zeros(0, 3)

    def nearest(self, points_world: Tensor, bins: Tensor, max_distance_m: float) -> Neighbours:
        raise AssertionError("no points to look up")

    def search(self, points_world: Tensor, max_distance_m: float, last: Neighbours | None = None) -> Correspondences:
        feet = points_world * torch.tensor([1.0, 1.0, 0.0])
        feet[::2, 0] += self.beside_m
        feet[1::2, 0] -= self.beside_m
        up = torch.tensor([0.0, 0.0, 1.0]).expand_as(feet)
        return Correspondences(feet, up, points_world[:, 2].abs() <= max_distance_m)


def test_registration_to_plane_has_closed_form():
    """Height, roll and pitch follow the plane; x, y and yaw stay."""
    start = torch.tensor([4.0, -3.0, 0.3, 0.05, -0.04, 0.7], dtype=torch.float64)
    result = GaussNewton(weight=NoWeight()).register(ON_PLANE, _Plane(), se3.from_euler(start), 3.0)
    end = se3.to_euler(result.T_world_lidar)
    assert result.converged and result.rmse_m < 1e-4
    assert end[2:5].abs().max() < 1e-4
    assert (end[:2] - start[:2]).abs().max() < 0.05 and (end[5] - start[5]).abs() < 0.01
    assert result.information[:2].max() < 1e-6 < 0.9 < result.information[2]


@pytest.mark.parametrize(
    "setting", [{"narrowing": 1.0}, {"search_distance_m": 0.0}, {"max_iterations": 0}, {"coarse_stride": 0}]
)
def test_settings_without_progress_are_refused(setting):
    with pytest.raises(ValueError, match=f"{next(iter(setting))}={next(iter(setting.values()))}"):
        GaussNewton(**setting)


def one_step(height_m: float = 0.0, pitch: float = 0.0, **settings) -> RegistrationResult:
    """A single step towards the plane."""
    start = se3.exp(torch.tensor([0, 0, height_m, 0, pitch, 0], dtype=torch.float64))
    return GaussNewton(weight=NoWeight(), max_iterations=1, **settings).register(ON_PLANE, _Plane(), start, 3.0)


def test_steps_are_limited():
    result, turned = one_step(height_m=2.5, max_step_m=0.4), one_step(pitch=0.1, max_step_deg=2.0)
    assert result.T_world_lidar[2, 3].item() == pytest.approx(2.1, abs=1e-6)
    assert result.iterations == 1 and not result.converged
    assert math.degrees(0.1) - se3.rotation_angle(turned.T_world_lidar).rad2deg().item() == pytest.approx(2.0, abs=1e-3)


def test_result_of_unfinished_registration_is_of_last_pose():
    result = one_step(height_m=0.6)
    assert not result.converged and result.T_world_lidar[2, 3].abs() < 1e-3
    assert result.rmse_m < 1e-3 and result.inlier_share == 1 and result.fit > 0.99


def test_result_equals_closed_forms():
    """Three quarters of the points are off the plane, as far above it as below, so that the scan does not move."""
    points = ON_PLANE[:400].repeat(2, 1)
    points[:, 2] = torch.tensor([0.0, 0.1, 0.1, 0.3]).repeat(200) * torch.tensor([1.0, -1.0]).repeat_interleave(400)
    gauss_newton = GaussNewton(weight=Huber(0.1), inlier_residual_m=0.2, fit_residual_m=0.05)
    result = gauss_newton.register(points, _Plane(), se3.identity(), 0.5)
    assert result.overlap == 1 and result.inlier_share == 0.75
    assert result.fit.item() == pytest.approx(0.25 + 0.5 * math.exp(-4), abs=1e-4)
    squares, weights = 0.5 * 0.1**2 + 0.25 * 0.3**2 / 3, 0.75 + 0.25 / 3  # Huber's at 0.3 m is a third
    assert result.rmse_m.item() == pytest.approx(math.sqrt(squares / weights), abs=1e-4)


def test_point_to_point_result_uses_distance_to_surface():
    gauss_newton = GaussNewton(residual=PointToPoint(), weight=NoWeight(), max_iterations=3)
    result = gauss_newton.register(ON_PLANE, _Plane(beside_m=0.3), se3.identity(), 0.5)
    assert result.inlier_share == 1 and result.fit > 0.99


@all_associations
def test_moving_outliers_do_not_bias_pose(association):
    """A fifth of the scan belongs to something that moved by 0.4 m."""
    scene = maps.scene("room", association)
    queries = scene.queries.clone()
    queries[::5] += torch.tensor([0.4, 0.4, 0.0])
    gauss_newton = solver(association, weight=GemanMcClure())
    start = scene.T_world_lidar @ se3.exp(torch.tensor([0.1, -0.1, 0, 0, 0, 0.02], dtype=torch.float64))
    result = gauss_newton.register(queries, scene.association, start, 1.0)
    distance, angle = maps.errors(result.T_world_lidar, scene.T_world_lidar)
    assert distance < 0.02 and angle < 0.15
