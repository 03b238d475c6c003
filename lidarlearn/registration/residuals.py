"""Residuals of correspondences and their derivatives by a small motion of the new scan.

The motion is applied in the new scan's own frame, T <- T exp(xi) with xi = (translation, rotation), so that the
derivatives are well conditioned at any distance from the map's origin.
"""

from abc import ABC, abstractmethod
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from lidarlearn.errors import require_positive
from lidarlearn.geometry import se3


class Residual(ABC):
    """A registration minimizes the weighted sum of its squares."""

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
            points: points of the new scan, in its own frame.
            points_world: the same points, in the map's frame.
            map_points: the map point associated with each.
            map_normals: unit normals of the map points, zero where undefined.
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
        normals_lidar = map_normals @ T_world_lidar[..., :3, :3].to(points)  # R^T n
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
    """T p - q, whitened by the covariances of both surfaces.

    Each point stands for a disc of unit variance along its surface and `epsilon` across it. The residual is
    L^T (T p - q) with (C_q + R C_p R^T)^-1 = L L^T, so its square is the Mahalanobis distance of Segal et al.,
    "Generalized-ICP", RSS 2009. It is scaled to be the point-to-plane distance where the two surfaces are parallel. A
    new point without a normal takes that of the map point.

    Args:
        epsilon: variance across the surface, relative to the variance along it.
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
        own = torch.where((own != 0).any(-1, keepdim=True), own, map_normals)
        covariance = self._disc(map_normals) + self._disc(own)
        whitening = torch.linalg.cholesky(torch.linalg.inv(covariance)).mT * (2 * self.epsilon) ** 0.5
        return whitening @ _point_jacobians(T_world_lidar, points, points_world - map_points)

    def _disc(self, normals: Float[Tensor, "*batch 3"]) -> Float[Tensor, "*batch 3 3"]:
        eye = torch.eye(3, dtype=normals.dtype, device=normals.device)
        return eye - (1 - self.epsilon) * normals[..., :, None] * normals[..., None, :]


def _point_jacobians(
    T_world_lidar: Float[Tensor, "*batch 4 4"], points: Float[Tensor, "n 3"], offsets: Float[Tensor, "*batch n 3"]
) -> Float[Tensor, "*batch n 3 7"]:
    """[J r] with J = d(T exp(xi) p)/dxi = [R, -R hat(p)] and the offsets as residuals."""
    R = T_world_lidar[..., None, :3, :3].to(points)
    R = R.expand(*R.shape[:-3], len(points), 3, 3)
    return torch.cat([R, -R @ se3.hat(points), offsets[..., None]], dim=-1)
