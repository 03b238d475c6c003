"""Residuals of correspondences and their derivatives by a small motion of the new scan.

The motion is applied in the new scan's own frame, T <- T exp(xi) with xi = (translation, rotation): the derivatives
are then well conditioned however far the sensor is from the map's origin.
"""

from abc import ABC, abstractmethod
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from lidarlearn.errors import require_positive
from lidarlearn.geometry import se3


class Residual(ABC):
    """What a registration minimizes the weighted squares of."""

    needs_normals = False  # of the new scan's points

    @abstractmethod
    def linearize(
        self,
        T_world_lidar: Float[Tensor, "*batch 4 4"],
        points: Float[Tensor, "n 3"],
        points_world: Float[Tensor, "*batch n 3"],
        map_points: Float[Tensor, "*batch n 3"],
        map_normals: Float[Tensor, "*batch n 3"],
        normals: Float[Tensor, "n 3"] | None = None,
    ) -> Float[Tensor, "*batch n k 7"]:
        """Residuals and their Jacobians at a pose, k of each for every correspondence.

        Args:
            T_world_lidar: pose of the new scan.
            points: its points, in its own frame.
            points_world: the same points, in the map's frame.
            map_points: the points they are associated with.
            map_normals: unit normals there, zero where undefined.
            normals: unit normals of the new scan, in its own frame; used by generalized ICP.

        Returns:
            The augmented Jacobian [J r]: derivatives by the motion, then the residual [m].
        """


class PointToPlane(Residual):
    """(T p - q) . n, the signed distance to the map's tangent plane [m].

    Source: Dellenbach et al. 2021, III-A "Energy minimized"; Chen & Medioni 1992.
    """

    def linearize(
        self,
        T_world_lidar: Tensor,
        points: Tensor,
        points_world: Tensor,
        map_points: Tensor,
        map_normals: Tensor,
        normals: Tensor | None = None,
    ) -> Tensor:
        """One residual per correspondence; zero where the map has no normal."""
        normals_lidar = map_normals @ T_world_lidar[..., :3, :3].to(points)  # R^T n, row by row
        r = ((points_world - map_points) * map_normals).sum(-1, keepdim=True)
        lever = torch.linalg.cross(points.expand_as(normals_lidar), normals_lidar)
        return torch.cat([normals_lidar, lever, r], dim=-1)[..., None, :]


class PointToPoint(Residual):
    """T p - q, all three coordinates [m]. Source: Besl & McKay 1992."""

    def linearize(
        self,
        T_world_lidar: Tensor,
        points: Tensor,
        points_world: Tensor,
        map_points: Tensor,
        map_normals: Tensor,
        normals: Tensor | None = None,
    ) -> Tensor:
        """Three residuals per correspondence."""
        return _point_jacobians(T_world_lidar, points, points_world - map_points)


@dataclass(frozen=True)
class GeneralizedIcp(Residual):
    """T p - q, whitened by the covariances of the two surfaces it lies between.

    Each point stands for a disc of unit variance along its surface and `epsilon` across it. With the whitening
    L of (C_q + R C_p R^T)^-1 = L L^T, scaled so that a plane met face to face gives the point-to-plane distance, the
    squared residual is the Mahalanobis distance of Segal et al., "Generalized-ICP", RSS 2009. A new point without a
    normal is taken to lie on the surface that it is matched with.

    Args:
        epsilon: variance across the surface over the variance along it.
    """

    epsilon: float = 1e-2
    needs_normals = True

    def __post_init__(self) -> None:
        require_positive("residual GeneralizedIcp", epsilon=self.epsilon)

    def linearize(
        self,
        T_world_lidar: Tensor,
        points: Tensor,
        points_world: Tensor,
        map_points: Tensor,
        map_normals: Tensor,
        normals: Tensor | None = None,
    ) -> Tensor:
        """Three residuals per correspondence."""
        if normals is None:
            raise ValueError("generalized ICP needs the normals of the new scan")
        R = T_world_lidar[..., :3, :3].to(points)
        own = normals @ R.mT
        own = torch.where((own != 0).any(-1, keepdim=True), own, map_normals)  # unknown: the surface it is matched with
        covariance = self._disc(map_normals) + self._disc(own)
        whitening = torch.linalg.cholesky(torch.linalg.inv(covariance)).mT * (2 * self.epsilon) ** 0.5
        return whitening @ _point_jacobians(T_world_lidar, points, points_world - map_points)

    def _disc(self, normals: Float[Tensor, "*batch 3"]) -> Float[Tensor, "*batch 3 3"]:
        eye = torch.eye(3, dtype=normals.dtype, device=normals.device)
        return eye - (1 - self.epsilon) * normals[..., :, None] * normals[..., None, :]


def _point_jacobians(
    T_world_lidar: Float[Tensor, "*batch 4 4"], points: Float[Tensor, "n 3"], offsets: Float[Tensor, "*batch n 3"]
) -> Float[Tensor, "*batch n 3 7"]:
    """d(T exp(xi) p)/dxi = [R, -R hat(p)], and the offsets beside it."""
    R = T_world_lidar[..., None, :3, :3].to(points)
    R = R.expand(*R.shape[:-3], len(points), 3, 3)
    return torch.cat([R, -R @ se3.hat(points), offsets[..., None]], dim=-1)
