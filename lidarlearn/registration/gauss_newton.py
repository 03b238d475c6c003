"""Gauss-Newton registration of a scan against a searchable map."""

import math
from dataclasses import dataclass, field

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from lidarlearn.geometry import se3
from lidarlearn.registration.association.base import Association, Neighbours
from lidarlearn.registration.normal_equations import NormalEquations, position_of
from lidarlearn.registration.residuals import PointToPlane, Residual
from lidarlearn.registration.weights import GemanMcClure, RobustWeight

_FEW = 0.1  # share of the points below which neighbours are too few for what they say to be believed


@dataclass(frozen=True)
class RegistrationResult:
    """Where a scan fits, and how well: enough to judge an alignment instead of trusting it.

    Tensors share the batch shape of the initial poses, and are on the CPU as poses are.

    Args:
        T_world_lidar: the registered poses, float64.
        iterations: Gauss-Newton steps taken, those of the slowest of a batch.
        converged: whether the last step was below the tolerances, at the final search distance.
        overlap: share of the points that have a map neighbour with a normal within the search distance.
        inlier_share: share of those whose distance d from the map's surface is below `inlier_residual_m`.
        fit: mean over all points of exp(-(d / fit_residual_m)^2), 0 for those without a neighbour: sharper than the
            inlier share, it tells the right pose from its neighbours.
        rmse_m: weighted root mean square of the residuals [m].
        hessian: of the weighted half squares by (translation [m], rotation [rad]) in the sensor's frame.
        information: weighted share of all points that notice a move along each of the three axes of the position's
            covariance, ascending: 0 along a corridor, where no residual changes however the pose follows.
        weakest_direction: unit vector, in the sensor's frame, of the smallest of them.
    """

    T_world_lidar: Float[Tensor, "*batch 4 4"]
    iterations: int
    converged: Bool[Tensor, "*batch"]
    overlap: Float[Tensor, "*batch"]
    inlier_share: Float[Tensor, "*batch"]
    fit: Float[Tensor, "*batch"]
    rmse_m: Float[Tensor, "*batch"]
    hessian: Float[Tensor, "*batch 6 6"]
    information: Float[Tensor, "*batch 3"]
    weakest_direction: Float[Tensor, "*batch 3"]


@dataclass(frozen=True)
class GaussNewton:
    """Iteratively reweighted Gauss-Newton with a search distance that narrows.

    Args:
        residual: what is minimized.
        weight: the robust weight.
        max_iterations: steps at most.
        search_distance_m: correspondences are searched within this distance at the end [m].
        narrowing: factor of the search distance from one iteration to the next, until it is `search_distance_m`; the
            scale of the robust weight narrows with it (graduated non-convexity, Blake & Zisserman 1987).
        coarse_stride: while the search distance is wider, only every so manieth point is used.
        min_information: the position is left as initialized in directions of which the map says less than this, see
            `RegistrationResult.information`. Source: after Zhang, Kaess & Singh, "On degeneracy of optimization-based
            state estimation problems", ICRA 2016.
        inlier_residual_m: a correspondence counts as an inlier below this distance from the map's surface [m].
        fit_residual_m: scale of `RegistrationResult.fit` [m].
        translation_tolerance_m: converged when a step is shorter [m]...
        rotation_tolerance_deg: ...and turns by less [deg].
        max_step_m: longest translation of one step [m].
        max_step_deg: largest rotation of one step [deg].
    """

    residual: Residual = field(default_factory=PointToPlane)
    weight: RobustWeight = field(default_factory=GemanMcClure)
    max_iterations: int = 50
    search_distance_m: float = 0.5
    narrowing: float = 0.85
    coarse_stride: int = 4
    min_information: float = 1e-3
    inlier_residual_m: float = 0.2
    fit_residual_m: float = 0.05
    translation_tolerance_m: float = 1e-3
    rotation_tolerance_deg: float = 5e-3
    max_step_m: float = 1.0
    max_step_deg: float = 10.0

    def __post_init__(self) -> None:
        if not (0 < self.narrowing < 1 and self.search_distance_m > 0):
            raise ValueError(
                "registration: narrowing must be between 0 and 1 and search_distance_m above 0, got "
                f"narrowing={self.narrowing}, search_distance_m={self.search_distance_m}"
            )
        if self.max_iterations < 1 or self.coarse_stride < 1:
            raise ValueError(
                "registration: max_iterations and coarse_stride must be at least 1, got "
                f"max_iterations={self.max_iterations}, coarse_stride={self.coarse_stride}"
            )

    @property
    def _tolerances(self) -> Float[Tensor, "2"]:
        tolerances = [self.translation_tolerance_m, math.radians(self.rotation_tolerance_deg)]
        return torch.tensor(tolerances, dtype=torch.float64)

    @property
    def _longest(self) -> Float[Tensor, "2"]:
        return torch.tensor([self.max_step_m, math.radians(self.max_step_deg)], dtype=torch.float64)

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
            T_world_lidar: initial poses, float64, on any device.
            search_distance_m: search distance of the first iteration [m].
            normals: unit normals of the new scan; only generalized ICP needs them.

        Returns:
            The result; with nothing to hold on to, the initial pose, not converged, with an overlap of 0.
        """
        T = T_world_lidar.cpu()
        converged = torch.zeros(T.shape[:-2], dtype=torch.bool)
        distance, iterations, found = search_distance_m, 0, None
        while not iterations or (iterations < self.max_iterations and not converged.all()):
            iterations += 1
            final = distance <= self.search_distance_m
            stride = 1 if final else self.coarse_stride
            used_normals = None if normals is None else normals[::stride]
            distance = max(distance, self.search_distance_m)
            equations = self._linearize(points[::stride], association, T, distance, used_normals, found)
            found = equations.found
            step = torch.where(converged[..., None], 0.0, self._solve(equations))
            T = T @ se3.exp(step)
            if final:
                is_small = (_lengths(step) < self._tolerances).all(-1)
                converged = converged | (is_small & (equations.H != 0).flatten(-2).any(-1))
            distance *= self.narrowing
        T = se3.orthonormalize(T)
        if not converged.all():  # else the last equations describe all of them, but for a small step
            equations = self._linearize(points, association, T, self.search_distance_m, normals, found)
        return self._judge(T, iterations, converged, equations)

    def agreement(
        self,
        points: Float[Tensor, "n 3"],
        association: Association,
        T_world_lidar: Float[Tensor, "*batch 4 4"],
        search_distance_m: float,
        normals: Float[Tensor, "n 3"] | None = None,
    ) -> Float[Tensor, "*batch"]:
        """How well poses far from each other agree with the map: the share of points that fit, of all with a neighbour.

        Unlike `RegistrationResult.fit` it is not drawn to where most points have a neighbour. The rings of a scan on
        the ground lie on those of the scan before when the sensor is taken to stand still, however fast it drives.

        Args:
            points: the new scan [m], in its own frame.
            association: the map.
            T_world_lidar: poses, float64.
            search_distance_m: what is farther from the map says nothing [m]: wide enough to see what does not fit.
            normals: as in `register`.
        """
        equations = self._linearize(points, association, T_world_lidar, search_distance_m, normals)
        fit, neighbours = self._fits(equations).sum(-1), equations.mask.sum(-1)
        return (fit / (neighbours + _FEW * max(len(points), 1))).cpu()

    def _linearize(
        self,
        points: Tensor,
        association: Association,
        T: Tensor,
        distance_m: float,
        normals: Tensor | None,
        last: Neighbours | None = None,
    ) -> NormalEquations:
        T = T.to(points)
        points_world = se3.transform(T, points)
        found = association.search(points_world.reshape(-1, 3), distance_m, last)
        map_points = found.points.view_as(points_world)
        map_normals = found.normals.view_as(points_world)
        mask = (found.mask & (found.normals != 0).any(dim=-1)).view(points_world.shape[:-1])
        linear = self.residual.linearize(T, points, points_world, map_points, map_normals, normals)
        offsets = points_world - map_points
        is_distance = linear.residuals.shape[-1] == 1
        size = linear.residuals[..., 0].abs() if is_distance else linear.residuals.norm(dim=-1)
        widening = distance_m / self.search_distance_m  # a narrow kernel would hold on to whatever is near by chance
        squared_distances = offsets.square().sum(-1)
        weights = self.weight.weight(size / widening, squared_distances / widening**2) * mask
        # Summed in single precision, H would no longer tell "nothing is known" from its own rounding.
        rows = linear.rows.double()
        sums = ((rows * weights[..., None, None]).flatten(-3, -2).mT @ rows.flatten(-3, -2)).cpu()
        return NormalEquations(
            H=sums[..., :6, :6],
            g=sums[..., :6, 6],
            squares=sums[..., 6, 6],
            found=found.neighbours,
            mask=mask,
            # Whatever is minimized, a pose is judged by how far points are off the map's surface, not along it.
            off_m=size if is_distance else (offsets * map_normals).sum(-1).abs(),
            weights=weights,
            jacobians=linear.jacobians,
        )

    def _solve(self, equations: NormalEquations) -> Float[Tensor, "*batch 6"]:
        """The minimum of the linearized energy, on condition that the position stays where nothing is known of it."""
        position = position_of(equations)
        step = -(position.covariance @ equations.g[..., None])
        unknown = (position.information < self.min_information)[..., None]
        along = position.directions.mT @ step[..., :3, :]
        step = step - position.responses @ (unknown * along)
        step = step[..., 0]
        excess = _lengths(step) / self._longest
        return step / excess.amax(dim=-1, keepdim=True).clamp(min=1)

    def _judge(self, T: Tensor, iterations: int, converged: Tensor, equations: NormalEquations) -> RegistrationResult:
        position = position_of(equations)
        order = position.information.argsort(dim=-1)
        neighbour = equations.mask.double()
        sums = [
            neighbour,
            neighbour * (equations.off_m < self.inlier_residual_m),
            self._fits(equations),
            equations.weights,
        ]
        neighbours, inliers, fit, weight = torch.stack(sums).sum(-1).cpu()
        points = max(equations.mask.shape[-1], 1)
        return RegistrationResult(
            T_world_lidar=T,
            iterations=iterations,
            converged=converged,
            overlap=neighbours / points,
            inlier_share=inliers / neighbours.clamp(min=1),
            fit=fit / points,
            rmse_m=(equations.squares / weight.clamp(min=1e-12)).sqrt(),
            hessian=equations.H,
            information=position.information.gather(-1, order),
            weakest_direction=position.directions.take_along_dim(order[..., None, :], dim=-1)[..., 0],
        )

    def _fits(self, equations: NormalEquations) -> Float[Tensor, "*batch m"]:
        """How well each point fits the map's surface, 0..1, 0 without a neighbour."""
        return equations.mask * torch.exp(-((equations.off_m / self.fit_residual_m) ** 2))


def _lengths(xi: Float[Tensor, "*batch 6"]) -> Float[Tensor, "*batch 2"]:
    """Translation [m] and angle [rad] of small motions."""
    return xi.unflatten(-1, (2, 3)).norm(dim=-1)
