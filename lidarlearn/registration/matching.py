"""Correspondences of a scan with a map, weighted and linearized into normal equations."""

import functools
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float, Float64
from torch import Tensor

from lidarlearn import cuda_graphs
from lidarlearn.geometry import se3
from lidarlearn.registration.association.base import Association, Neighbours
from lidarlearn.registration.normal_equations import NormalEquations, Terms, augmented_hessian
from lidarlearn.registration.residuals import Residual
from lidarlearn.registration.weights import RobustWeight

_PADDING = cuda_graphs.Padding(value=1e6)  # coordinates [m] far from any map point

_HessianAndTerms = tuple[Float64[Tensor, "*batch 7 7"], Terms]


@dataclass(frozen=True)
class Queries:
    """Points to register.

    Args:
        points: the points [m], in the new scan's frame.
        normals: their unit normals, if the residual needs them.
    """

    points: Float[Tensor, "n 3"]
    normals: Float[Tensor, "n 3"] | None

    def every(self, stride: int) -> "Queries":
        """Every n-th point."""
        return Queries(self.points[::stride], None if self.normals is None else self.normals[::stride])


@dataclass(frozen=True)
class Matching:
    """Matches a scan with a map, and linearizes the result.

    Args:
        residual: what is minimized.
        weight: the robust weight.
        search_distance_m: the final search distance [m]. While the search is wider, the scale of the weight is wider by
            the square of the ratio.
        association: the map.
    """

    residual: Residual
    weight: RobustWeight
    search_distance_m: float
    association: Association

    def equations(
        self,
        queries: Queries,
        T_world_lidar: Float64[np.ndarray, "*batch 4 4"],
        distance_m: float,
        last: Neighbours | None = None,
    ) -> NormalEquations:
        """The normal equations at one or several poses.

        Args:
            queries: the scan.
            T_world_lidar: the poses.
            distance_m: search distance [m].
            last: neighbours of the last call with the same queries, see `Association.search`.
        """
        points, graphs = queries.points, self.graphs(queries)
        if graphs is None:
            T = torch.from_numpy(T_world_lidar).to(points)
            hessian, terms = self._terms(points, T, distance_m, distance_m, queries.normals, last)
            return NormalEquations.of(hessian.cpu(), terms, len(points))
        reach_m = self.association.reach_m(distance_m)
        hessian, terms = graphs(
            functools.partial(self._terms_in_graph, shape=T_world_lidar.shape, reach_m=reach_m),
            points,
            torch.from_numpy(np.append(T_world_lidar, distance_m)),  # one transfer
            device=points.device,
            settings=(self.residual, self.weight, self.search_distance_m, reach_m, T_world_lidar.shape),
            padding=_PADDING,
            keeps_first=True,
            reads_first=True,
        )
        return NormalEquations.of(hessian, terms, len(points))

    def graphs(self, queries: Queries) -> cuda_graphs.GraphCache | None:
        """CUDA graphs of the terms; None if they are not captured, as in generalized ICP, which inverts matrices."""
        is_captured = cuda_graphs.supported_on(queries.points.device) and queries.normals is None
        return self.association.graphs if is_captured else None

    def _terms_in_graph(
        self, points: Float[Tensor, "n 3"], numbers: Float[Tensor, "_"], shape: tuple[int, ...], reach_m: float
    ) -> _HessianAndTerms:
        numbers = numbers.to(points)
        return self._terms(points, numbers[:-1].view(shape), numbers[-1], reach_m)

    def _terms(
        self,
        points: Float[Tensor, "n 3"],
        T: Float[Tensor, "*batch 4 4"],
        distance_m: float | Float[Tensor, ""],
        reach_m: float,
        normals: Float[Tensor, "n 3"] | None = None,
        last: Neighbours | None = None,
    ) -> _HessianAndTerms:
        """Search neighbours within `reach_m`, and use those within `distance_m`."""
        points_world = se3.transform(T, points)
        found = self.association.search(points_world.reshape(-1, 3), reach_m, last)
        map_points = found.points.view_as(points_world)
        map_normals = found.normals.view_as(points_world)
        mask = (found.mask & (found.normals != 0).any(dim=-1)).view(points_world.shape[:-1])
        augmented_jacobians = self.residual.linearize(T, points, points_world, map_points, map_normals, normals)
        residuals, offsets = augmented_jacobians[..., 6], points_world - map_points
        is_distance = residuals.shape[-1] == 1
        size = residuals[..., 0].abs() if is_distance else residuals.norm(dim=-1)
        # A narrow kernel would keep what is near by chance. Squared, it includes residuals as large as the distance.
        widening = (distance_m / self.search_distance_m) ** 2
        squared_distances = offsets.square().sum(-1)
        if isinstance(distance_m, Tensor):
            mask = mask & (squared_distances <= distance_m**2)
        weights = self.weight.weight(size / widening, squared_distances / widening**2) * mask
        return augmented_hessian(augmented_jacobians.double(), weights), Terms(
            neighbours=found.neighbours,
            mask=mask,
            # A pose is judged by the distance across the map's surface, not along it, whatever is minimized.
            surface_distances_m=size if is_distance else (offsets * map_normals).sum(-1).abs(),
            weights=weights,
            augmented_jacobians=augmented_jacobians,
        )
