"""The registration half of an odometry: sampling, local map and Gauss-Newton under one name such as `kd_f2m`."""

import math
from collections.abc import Callable
from dataclasses import dataclass, field, replace

import torch
from jaxtyping import Float, Int
from torch import Tensor

from lidarlearn.errors import require_positive
from lidarlearn.geometry import se3
from lidarlearn.odometry.deskew import deskew
from lidarlearn.odometry.local_map import LocalMap
from lidarlearn.odometry.sampling import SampledScan, Sampling
from lidarlearn.registration.association.voxel_map import neighbourhood_normals
from lidarlearn.registration.gauss_newton import GaussNewton
from lidarlearn.registration.result import RegistrationResult

# Coarse, as hypotheses are only compared: the best one is registered again.
_HYPOTHESIS_ITERATIONS = 20
_HYPOTHESIS_TOLERANCE = 10  # times the registration's
_HYPOTHESIS_ROUNDS = 2  # of deskewing


@dataclass
class Backend:
    """Registers scans against a local map.

    Args:
        sampling: which points are used.
        local_map: the scans to register against.
        registration: how scans are registered.
        max_search_distance_m: widest search distance, used where the error of a guess may be large [m].
        hypothesis_points: number of points with which hypotheses, i.e. several initial poses, are compared.
        hypothesis_distance_m: search distance of hypotheses [m]. Wider than the distance between them, so that no pose
            is missed; but not much wider, as projective association would pull all of them to a standstill on a
            motorway.
    """

    sampling: Sampling
    local_map: LocalMap
    registration: GaussNewton = field(default_factory=GaussNewton)
    max_search_distance_m: float = 3.0
    hypothesis_points: int = 2000
    hypothesis_distance_m: float = 1.5

    def __post_init__(self) -> None:
        require_positive(
            "odometry", hypothesis_points=self.hypothesis_points, hypothesis_distance_m=self.hypothesis_distance_m
        )

    def register(
        self,
        scan: SampledScan,
        T_previous_new: Float[Tensor, "4 4"],
        T_world_previous: Float[Tensor, "4 4"],
        guess_error_m: float,
        motion_per_period: Callable[[Tensor], Tensor] = lambda T_previous_new: T_previous_new,
    ) -> RegistrationResult:
        """Register a scan from one guess of its motion.

        Points with times are deskewed by the guess and registered, then deskewed by the result and registered again.
        On a pitching Segway this halves the error of the motion.

        Args:
            scan: the new scan.
            T_previous_new: the guess.
            T_world_previous: pose of the previous scan.
            guess_error_m: how far points may be from where the guess puts them [m].
            motion_per_period: converts the motion since the previous pose to that over one scan period.
        """
        final_m = self.registration.search_distance_m
        distance_m = min(final_m + 2 * guess_error_m, self.max_search_distance_m)
        T_guess = T_world_previous @ T_previous_new
        result = self._register(scan, motion_per_period(T_previous_new), T_guess, distance_m)
        if scan.times is None:
            return result
        found = se3.orthonormalize(se3.inverse(T_world_previous) @ result.T_world_lidar)
        again = self._register(scan, motion_per_period(found), T_world_previous @ found, final_m)
        return replace(again, iterations=result.iterations + again.iterations)

    def _register(
        self, scan: SampledScan, motion_per_period: Tensor, T_world_lidar: Tensor, distance_m: float
    ) -> RegistrationResult:
        points = scan.deskewed(motion_per_period)
        return self.registration.register(
            points[scan.queries],
            self.local_map.association,
            T_world_lidar,
            distance_m,
            self.normals(points, scan.queries),
            scan.phases[scan.queries],
        )

    def register_hypotheses(
        self, scan: SampledScan, T_previous_new: Float[Tensor, "h 4 4"], T_world_previous: Tensor, deskews: bool = True
    ) -> tuple[Float[Tensor, "h 4 4"], Float[Tensor, "h"]]:
        """Register a few points of the scan from each of several guesses.

        Args:
            scan: the new scan.
            T_previous_new: the guesses.
            T_world_previous: pose of the previous scan.
            deskews: whether points with times are deskewed by each guess, and again by the motion registered from it:
                without that, a scan of a sudden turn fits nowhere.

        Returns:
            The motion registered from each guess, and its agreement, see `GaussNewton.agreement`.
        """
        chosen = scan.queries[:: max(math.ceil(len(scan.queries) / self.hypothesis_points), 1)]
        points, normals = scan.points[chosen], self.normals(scan.points, chosen)
        if scan.times is None or not deskews:
            motions = self._hypotheses(points, normals, T_previous_new, T_world_previous)
            return motions, self._agreement(points, normals, T_world_previous @ motions)
        times, found, agreements = scan.times[chosen], [], []
        for T in T_previous_new.unbind():
            for _ in range(_HYPOTHESIS_ROUNDS):
                T = self._hypotheses(deskew(points, times, T), normals, T, T_world_previous)
            found.append(T)
            agreements.append(self._agreement(deskew(points, times, T), normals, T_world_previous @ T))
        return torch.stack(found), torch.stack(agreements)

    def _hypotheses(
        self,
        points: Float[Tensor, "n 3"],
        normals: Float[Tensor, "n 3"] | None,
        T_previous_new: Float[Tensor, "*batch 4 4"],
        T_world_previous: Tensor,
    ) -> Float[Tensor, "*batch 4 4"]:
        """Register some points, coarsely, from one or several guesses of the motion."""
        quick = replace(
            self.registration,
            max_iterations=_HYPOTHESIS_ITERATIONS,
            translation_tolerance_m=_HYPOTHESIS_TOLERANCE * self.registration.translation_tolerance_m,
            rotation_tolerance_deg=_HYPOTHESIS_TOLERANCE * self.registration.rotation_tolerance_deg,
        )
        T_initial, association = T_world_previous @ T_previous_new, self.local_map.association
        result = quick.register(points, association, T_initial, self.hypothesis_distance_m, normals)
        return se3.orthonormalize(torch.linalg.solve(T_world_previous, result.T_world_lidar))

    def agreement(self, scan: SampledScan, T_previous_new: Tensor, T_world_previous: Tensor) -> float:
        """Agreement of a motion with the map, see `GaussNewton.agreement`."""
        points = scan.deskewed(T_previous_new)
        normals = self.normals(points, scan.queries)
        return self._agreement(points[scan.queries], normals, T_world_previous @ T_previous_new).item()

    def _agreement(self, points: Float[Tensor, "n 3"], normals: Tensor | None, T_world_lidar: Tensor) -> Tensor:
        association, distance_m = self.local_map.association, self.hypothesis_distance_m
        return self.registration.agreement(points, association, T_world_lidar, distance_m, normals)

    def normals(self, points: Float[Tensor, "n 3"], chosen: Int[Tensor, "m"]) -> Float[Tensor, "m 3"] | None:
        """Normals of the chosen points, from their neighbours among all points; None if the residual needs none."""
        if not self.registration.residual.needs_normals:
            return None
        return neighbourhood_normals(points, self.sampling.neighbourhood_m)[chosen]
