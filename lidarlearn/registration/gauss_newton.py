"""Gauss-Newton registration of a scan against a searchable map."""

from dataclasses import dataclass, field

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from lidarlearn.geometry import se3
from lidarlearn.registration.association.base import Association
from lidarlearn.registration.residuals import PointToPlane, Residual
from lidarlearn.registration.weights import Proximity, RobustWeight


@dataclass(frozen=True)
class RegistrationResult:
    """Where a scan fits, and how well: enough to judge an alignment instead of trusting it.

    All fields share the batch shape of the initial poses.

    Args:
        T_world_lidar: the registered poses, float64.
        iterations: Gauss-Newton steps taken.
        converged: whether the last step was below the tolerances, at the final search distance.
        overlap: share of the points that have a map neighbour with a normal within the search distance.
        inlier_share: share of those whose residual is below `inlier_residual_m`.
        rmse_m: weighted root mean square of the residuals [m].
        hessian: of the weighted half squares by (translation [m], rotation [rad]) in the sensor's frame.
        information: the six eigenvalues, ascending, of the Hessian per unit of weight, with rotations measured by
            the displacement they cause at the mean range: 1 means that every residual sees the direction fully.
        weakest_direction: unit eigenvector (translation, rotation) of the smallest of them.
    """

    T_world_lidar: Float[Tensor, "*batch 4 4"]
    iterations: int
    converged: Bool[Tensor, "*batch"]
    overlap: Float[Tensor, "*batch"]
    inlier_share: Float[Tensor, "*batch"]
    rmse_m: Float[Tensor, "*batch"]
    hessian: Float[Tensor, "*batch 6 6"]
    information: Float[Tensor, "*batch 6"]
    weakest_direction: Float[Tensor, "*batch 6"]


@dataclass(frozen=True)
class _System:
    """Normal equations H xi = -g of one iteration, and what they were made of."""

    H: Float[Tensor, "*batch 6 6"]
    g: Float[Tensor, "*batch 6"]
    weight: Float[Tensor, "*batch"]
    neighbours: Int[Tensor, "*batch"]
    inliers: Int[Tensor, "*batch"]
    squares: Float[Tensor, "*batch"]


@dataclass(frozen=True)
class GaussNewton:
    """Iteratively reweighted Gauss-Newton with a search distance that narrows.

    Args:
        residual: what is minimized.
        weight: the robust weight.
        max_iterations: steps at most.
        search_distance_m: correspondences are searched within this distance at the end [m].
        narrowing: factor of the search distance from one iteration to the next, until it is `search_distance_m`.
        coarse_stride: while the search distance is wider, only every so manieth point is used.
        min_information: directions in which the map says less than this are left as initialized; see
            `RegistrationResult.information`. Source: Zhang, Kaess & Singh, "On degeneracy of optimization-based
            state estimation problems", ICRA 2016.
        inlier_residual_m: a correspondence counts as an inlier below this residual [m].
        translation_tolerance_m: converged when a step is shorter [m]...
        rotation_tolerance_deg: ...and turns by less [deg].
        max_step_m: longest translation of one step [m].
        max_step_deg: largest rotation of one step [deg].
    """

    residual: Residual = field(default_factory=PointToPlane)
    weight: RobustWeight = field(default_factory=Proximity)
    max_iterations: int = 30
    search_distance_m: float = 0.5
    narrowing: float = 0.85
    coarse_stride: int = 4
    min_information: float = 1e-3
    inlier_residual_m: float = 0.2
    translation_tolerance_m: float = 1e-3
    rotation_tolerance_deg: float = 5e-3
    max_step_m: float = 1.0
    max_step_deg: float = 10.0

    def register(
        self,
        points: Float[Tensor, "n 3"],
        association: Association,
        T_world_lidar: Float[Tensor, "*batch 4 4"],
        search_distance_m: float,
        normals: Float[Tensor, "n 3"] | None = None,
    ) -> RegistrationResult:
        """Move the scan to where it fits the map, from one or several initial poses at once.

        Args:
            points: the new scan [m], in its own frame.
            association: the map.
            T_world_lidar: initial poses, float64.
            search_distance_m: search distance of the first iteration [m].
            normals: unit normals of the new scan; only generalized ICP needs them.

        Returns:
            The result; with nothing to hold on to, the initial pose, not converged, with an overlap of 0.
        """
        T = T_world_lidar
        converged = torch.zeros(T.shape[:-2], dtype=torch.bool, device=T.device)
        distance, iteration = search_distance_m, 0
        for iteration in range(1, self.max_iterations + 1):
            final = distance <= self.search_distance_m
            stride = 1 if final else self.coarse_stride
            used_normals = None if normals is None else normals[::stride]
            distance = max(distance, self.search_distance_m)
            system = self._linearize(points[::stride], association, T, distance, used_normals)
            step = self._solve(system, points)
            T = T @ se3.exp(step)
            if final:
                converged = self._is_small(step) & (system.weight > 0)
                if converged.all():
                    break
            distance *= self.narrowing
        T = se3.orthonormalize(T)
        return self._judge(T, iteration, converged, self._linearize(
            points, association, T, self.search_distance_m, normals), points)

    def _linearize(
        self, points: Tensor, association: Association, T: Tensor, distance_m: float, normals: Tensor | None
    ) -> _System:
        points_world = se3.transform(T, points)
        found = association.search(points_world.reshape(-1, 3), distance_m)
        map_points = found.points.view_as(points_world)
        map_normals = found.normals.view_as(points_world)
        mask = (found.mask & (found.normals != 0).any(dim=-1)).view(points_world.shape[:-1])
        linear = self.residual.linearize(T, points, points_world, map_points, map_normals, normals)
        size = linear.residuals.norm(dim=-1)
        w = self.weight.weight(size, (points_world - map_points).square().sum(-1)) * mask
        J = linear.jacobians.flatten(-3, -2)
        wJ = (linear.jacobians * w[..., None, None]).flatten(-3, -2)
        return _System(
            H=(wJ.mT @ J).double(),
            g=(wJ.mT @ linear.residuals.flatten(-2)[..., None]).double()[..., 0],
            weight=w.sum(-1).double(),
            neighbours=mask.sum(-1),
            inliers=(mask & (size < self.inlier_residual_m)).sum(-1),
            squares=(w * size * size).sum(-1).double(),
        )

    def _solve(self, system: _System, points: Tensor) -> Float[Tensor, "*batch 6"]:
        """The step, without its part in directions of which the map says too little, and not too long."""
        information, directions, scale = _information(system, points)
        g = (system.g * scale)[..., None]
        eigenvalues = (information * system.weight[..., None]).clamp(min=torch.finfo(g.dtype).tiny)
        known = information > self.min_information
        step = -(directions @ ((directions.mT @ g)[..., 0] / eigenvalues * known)[..., None])[..., 0] * scale
        return self._limit(step)

    def _limit(self, step: Float[Tensor, "*batch 6"]) -> Float[Tensor, "*batch 6"]:
        max_angle = torch.pi / 180 * self.max_step_deg
        excess = torch.maximum(step[..., :3].norm(dim=-1) / self.max_step_m, step[..., 3:].norm(dim=-1) / max_angle)
        return step / excess.clamp(min=1)[..., None]

    def _is_small(self, step: Float[Tensor, "*batch 6"]) -> Bool[Tensor, "*batch"]:
        angle = step[..., 3:].norm(dim=-1) * (180 / torch.pi)
        return (step[..., :3].norm(dim=-1) < self.translation_tolerance_m) & (angle < self.rotation_tolerance_deg)

    def _judge(
        self, T: Tensor, iterations: int, converged: Tensor, system: _System, points: Tensor
    ) -> RegistrationResult:
        information, directions, _ = _information(system, points)
        return RegistrationResult(
            T_world_lidar=T,
            iterations=iterations,
            converged=converged,
            overlap=system.neighbours / max(len(points), 1),
            inlier_share=system.inliers / system.neighbours.clamp(min=1),
            rmse_m=(system.squares / system.weight.clamp(min=1e-12)).sqrt(),
            hessian=system.H,
            information=information,
            weakest_direction=directions[..., 0],
        )


def _information(system: _System, points: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Eigenvalues and eigenvectors of the scaled Hessian per unit of weight, and the scale of the six coordinates."""
    mean_range = points.norm(dim=-1).mean().clamp(min=1.0) if len(points) else points.new_ones(())
    scale = torch.ones(6, dtype=torch.float64, device=points.device)
    scale[3:] /= mean_range
    H = system.H * scale[:, None] * scale / system.weight.clamp(min=1e-12)[..., None, None]
    # 6x6 and on the critical path: a GPU's eigensolver would cost more than the trip.
    information, directions = torch.linalg.eigh(torch.nan_to_num(H).cpu())
    return information.to(points.device), directions.to(points.device), scale
