"""Gauss-Newton registration of a scan against a searchable map."""

import functools
import math
from collections.abc import Iterator
from dataclasses import dataclass, field

import numpy as np
import torch
from jaxtyping import Bool, Float, Float64
from torch import Tensor

from lidarlearn.errors import require_positive
from lidarlearn.geometry import se3
from lidarlearn.registration.association.base import Association
from lidarlearn.registration.elasticity import Elasticity
from lidarlearn.registration.matching import Matching, Queries
from lidarlearn.registration.normal_equations import NormalEquations, Terms
from lidarlearn.registration.residuals import PointToPlane, Residual
from lidarlearn.registration.result import RegistrationResult
from lidarlearn.registration.steps import retraction, step_sizes
from lidarlearn.registration.weights import GemanMcClure, RobustWeight

_MIN_MATCHED_SHARE = 0.1  # of the points, below which a good fit is likely to be chance


@dataclass(frozen=True)
class GaussNewton:
    """Iteratively reweighted Gauss-Newton with a narrowing search distance.

    Args:
        residual: what is minimized.
        weight: the robust weight.
        max_iterations: largest number of steps.
        search_distance_m: final search distance for correspondences [m].
        narrowing: factor of the search distance from one iteration to the next, until it is `search_distance_m`; the
            scale of the robust weight narrows with its square (graduated non-convexity, Blake & Zisserman 1987).
        coarse_stride: every n-th point is used while the search distance is wider than `search_distance_m`.
        min_information: along directions with less `RegistrationResult.information` than this, the position keeps its
            initial value. Source: after Zhang, Kaess & Singh, "On degeneracy of optimization-based
            state estimation problems", ICRA 2016.
        inlier_residual_m: points closer to the map's surface are inliers [m].
        fit_residual_m: scale of `RegistrationResult.fit` [m].
        translation_tolerance_m: converged if a step is shorter [m]...
        rotation_tolerance_deg: ...and its rotation smaller [deg].
        max_step_m: longest translation of one step [m].
        max_step_deg: largest rotation of one step [deg].
        elasticity: prior on the residual motion of scans with phases; None: every scan is rigid.
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
    translation_tolerance_m: float = 2e-3
    rotation_tolerance_deg: float = 1e-2
    max_step_m: float = 1.0
    max_step_deg: float = 10.0
    elasticity: Elasticity | None = field(default_factory=Elasticity)

    def __post_init__(self) -> None:
        if not 0 < self.narrowing < 1:
            raise ValueError(f"registration: narrowing must be between 0 and 1, got narrowing={self.narrowing}")
        positive = ("search_distance_m", "inlier_residual_m", "fit_residual_m", "max_step_m", "max_step_deg")
        require_positive("registration", **{name: getattr(self, name) for name in positive})
        if self.max_iterations < 1 or self.coarse_stride < 1:
            raise ValueError(
                "registration: max_iterations and coarse_stride must be at least 1, got "
                f"max_iterations={self.max_iterations}, coarse_stride={self.coarse_stride}"
            )

    @property
    def _tolerances(self) -> tuple[float, float]:
        return self.translation_tolerance_m, math.radians(self.rotation_tolerance_deg)

    @property
    def _max_step(self) -> tuple[float, float]:
        return self.max_step_m, math.radians(self.max_step_deg)

    def register(
        self,
        points: Float[Tensor, "n 3"],
        association: Association,
        T_world_lidar: Float[Tensor, "*batch 4 4"],
        search_distance_m: float,
        normals: Float[Tensor, "n 3"] | None = None,
        phases: Float[Tensor, "n"] | None = None,
    ) -> RegistrationResult:
        """Find the poses at which the scan fits the map, from one or several initial poses at once.

        Args:
            points: the new scan [m], in its own frame.
            association: the map.
            T_world_lidar: initial poses, float64, on any device.
            search_distance_m: search distance of the first iteration [m].
            normals: unit normals of the new scan; only generalized ICP needs them.
            phases: when each point was measured, as a share of the scan period; None: the scan is rigid.

        Returns:
            The result; without any correspondence the initial pose, not converged, with an overlap of 0.
        """
        T = T_world_lidar.cpu().numpy()
        converged = np.zeros(T.shape[:-2], dtype=bool)
        matching, queries = self._matching(association), Queries(points, normals)
        # A CUDA graph of fewer points would be an additional one, and no faster.
        is_captured = matching.graphs(queries) is not None
        coarse = queries if is_captured else queries.every(self.coarse_stride)
        iterations, neighbours = 0, None
        for distance_m in self._distances_m(search_distance_m):
            iterations += 1
            is_final_distance, T_linearized = distance_m == self.search_distance_m, T
            equations = matching.equations(queries if is_final_distance else coarse, T, distance_m, neighbours)
            neighbours = equations.terms.neighbours
            step = np.where(converged[..., None], 0.0, self._step(equations))
            T = T @ retraction(step)
            if is_final_distance:
                is_small = (step_sizes(step) < self._tolerances).all(-1)
                converged = np.asarray(converged | (is_small & (equations.H != 0).any((-2, -1))))
            if converged.all():  # the last equations describe the result up to a small step
                break
        else:
            T_linearized, equations = T, matching.equations(queries, T, self.search_distance_m, neighbours)
        skew = np.zeros((*T.shape[:-2], 6))
        if phases is not None and self.elasticity is not None:
            elastic = self.elasticity.equations(equations, phases)
            step = self._step(elastic.pose)
            T, skew = T_linearized @ retraction(step), elastic.skew(step)
        return self._judge(T, skew, iterations, converged, equations)

    def agreement(
        self,
        points: Float[Tensor, "n 3"],
        association: Association,
        T_world_lidar: Float[Tensor, "*batch 4 4"],
        search_distance_m: float,
        normals: Float[Tensor, "n 3"] | None = None,
    ) -> Float[Tensor, "*batch"]:
        """Share of the points with a neighbour that lie on the map's surface; comparable between distant poses.

        Unlike `RegistrationResult.fit` it does not favour poses where more points have a neighbour, such as standing
        still, where the ground rings of two scans coincide.

        Args:
            points: the new scan [m], in its own frame.
            association: the map.
            T_world_lidar: poses, float64.
            search_distance_m: search distance [m], wide enough to include points that do not fit.
            normals: as in `register`.
        """
        matching, T = self._matching(association), T_world_lidar.cpu().numpy()
        terms = matching.equations(Queries(points, normals), T, search_distance_m).terms
        fit, neighbours = self._fits(terms).sum(-1), terms.mask.sum(-1)
        return (fit / (neighbours + _MIN_MATCHED_SHARE * max(len(points), 1))).cpu()

    def _distances_m(self, first_m: float) -> Iterator[float]:
        """The search distance of each iteration [m]: narrowing from the first to `search_distance_m`."""
        for _ in range(self.max_iterations):
            yield max(first_m, self.search_distance_m)
            first_m *= self.narrowing

    def _matching(self, association: Association) -> Matching:
        return Matching(self.residual, self.weight, self.search_distance_m, association)

    def _step(self, equations: NormalEquations) -> Float64[np.ndarray, "*batch 6"]:
        """The minimum of the linearized energy, but without a move along degenerate directions of the position."""
        known = equations.localizability
        step = -(known.covariance @ equations.g[..., None])
        is_degenerate = (known.information < self.min_information)[..., None]
        along = known.directions.swapaxes(-1, -2) @ step[..., :3, :]
        step = (step - known.pose_directions @ (is_degenerate * along))[..., 0]
        excess = step_sizes(step) / self._max_step
        return step / np.maximum(excess.max(-1, keepdims=True), 1.0)

    def _judge(
        self,
        T: Float64[np.ndarray, "*batch 4 4"],
        skew: Float64[np.ndarray, "*batch 6"],
        iterations: int,
        converged: Bool[np.ndarray, "*batch"],
        equations: NormalEquations,
    ) -> RegistrationResult:
        directions, information = equations.localizability.directions, equations.localizability.information
        order = information.argsort(axis=-1)
        weakest = np.take_along_axis(directions, order[..., None, :], axis=-1)[..., 0]
        terms = equations.terms
        count = functools.partial(self._counts, terms)
        counts = terms.graphs(count, device=terms.mask.device, settings=self, reads_first=True)
        neighbours, inliers, fit, weight = counts.numpy()
        points = max(equations.points, 1)
        return RegistrationResult(
            T_world_lidar=se3.orthonormalize(torch.from_numpy(T)),
            skew=torch.from_numpy(skew),
            iterations=iterations,
            converged=torch.as_tensor(converged),
            overlap=torch.as_tensor(neighbours / points),
            inlier_share=torch.as_tensor(inliers / np.maximum(neighbours, 1)),
            fit=torch.as_tensor(fit / points),
            rmse_m=torch.as_tensor(np.sqrt(equations.squares / np.maximum(weight, 1e-12))),
            hessian=torch.from_numpy(equations.H),
            information=torch.from_numpy(np.take_along_axis(information, order, axis=-1)),
            weakest_direction=torch.from_numpy(weakest),
        )

    def _counts(self, terms: Terms) -> Float[Tensor, "4 *batch"]:
        """Sums over all points: those with a neighbour, the inliers, the fits and the weights."""
        neighbour = terms.mask.double()
        inlier = neighbour * (terms.surface_distances_m < self.inlier_residual_m)
        return torch.stack([neighbour, inlier, self._fits(terms), terms.weights]).sum(-1)

    def _fits(self, terms: Terms) -> Float[Tensor, "*batch m"]:
        """How well each point fits the map's surface, 0 to 1; 0 without a neighbour."""
        return terms.mask * torch.exp(-((terms.surface_distances_m / self.fit_residual_m) ** 2))
