"""Unsupervised training: point-to-plane alignment under projective association."""

from abc import ABC, abstractmethod
from collections.abc import Sequence

import torch
from jaxtyping import Bool, Float
from torch import Tensor, nn

from lidarlearn.geometry import se3
from lidarlearn.geometry.normals import normal_map
from lidarlearn.geometry.projection import SphericalProjection, activated
from lidarlearn.losses.result import LossResult

_FIT_RESIDUAL_M = 0.1  # scale of a fit: far below a motion, far above noise
_FEW = 0.1  # share of the reference's pixels below which those that are used are too few for their fit to be believed


class ProjectiveLoss(nn.Module, ABC):
    """L(T_ref_new) = 1/n_k sum rho over the n_k pixels activated in the reference and in the reprojected target.

    The target is transformed by the estimate and projected into the reference; each of its points meets the reference
    point of its pixel and that point's normal. Neither precomputed normals nor a KdTree are needed. Every pair of the
    batch has its own mean, so that a pair weighs the same whatever its overlap; a pair without overlap counts as zero
    and pulls nowhere.

    A subclass says what one correspondence costs: `rho`.

    Args:
        normal_window: rows and columns of the neighbourhood of reference normals [px], odd.
        max_range_jump: see `normal_map`; the fewer rows an image has, the larger the steps between them.
        max_roughness: see `normal_map`.

    Source: Dellenbach et al. 2021, III-B "Unsupervised training".
    """

    def __init__(
        self, normal_window: Sequence[int] = (3, 3), max_range_jump: float = 0.15, max_roughness: float = 0.2
    ) -> None:
        super().__init__()
        self.normal_window = (int(normal_window[0]), int(normal_window[1]))
        self.max_range_jump = max_range_jump
        self.max_roughness = max_roughness

    @abstractmethod
    def rho(
        self, residuals: Float[Tensor, "*batch"], squared_distances: Float[Tensor, "*batch"]
    ) -> Float[Tensor, "*batch"]:
        """Cost of correspondences.

        Args:
            residuals: signed distance of each target point to its reference point's plane [m].
            squared_distances: squared distance between the two points [m^2].
        """

    def forward(
        self,
        parameters: Float[Tensor, "batch 6"],
        reference: Float[Tensor, "batch 3 h w"],
        target: Float[Tensor, "batch 3 h w"],
        projection: SphericalProjection,
    ) -> LossResult:
        """How badly the estimate aligns the two scans.

        Args:
            parameters: the network's estimate of `T_ref_new`: translation [m] and Euler angles [rad].
            reference: vertex map of the earlier scan [m], zeros where no point fell.
            target: vertex map of the new scan [m], likewise.
            projection: the image that both were made with.
        """
        aligned = reproject(se3.from_euler(parameters), target, projection)
        with torch.no_grad():
            normals = self.normals(reference)
            defined = activated(normals)  # only activated pixels have one
            used = activated(aligned) & defined
        offsets = aligned - reference
        residuals = (offsets * normals).sum(dim=1)
        squared_distances = (offsets * offsets).sum(dim=1)

        def mean_over_used(values: Float[Tensor, "batch h w"]) -> Float[Tensor, ""]:
            n_k = used.sum(dim=(1, 2)).clamp(min=1)
            return ((values * used).sum(dim=(1, 2)) / n_k).mean()

        return LossResult(
            loss=mean_over_used(self.rho(residuals, squared_distances)),
            parts={
                "residual_m": mean_over_used(residuals.detach().abs()),
                "distance_m": mean_over_used(squared_distances.detach().sqrt()),
                "activated_share": used.float().mean(),
                "misfit": misfit(residuals.detach(), used, defined),
            },
        )

    def normals(self, reference: Float[Tensor, "*batch 3 h w"]) -> Float[Tensor, "*batch 3 h w"]:
        """Normals of a vertex map, zero where this loss takes them to be undefined."""
        return normal_map(reference, self.normal_window, self.max_range_jump, self.max_roughness)


def misfit(
    residuals: Float[Tensor, "batch h w"], used: Bool[Tensor, "batch h w"], defined: Bool[Tensor, "batch h w"]
) -> Float[Tensor, ""]:
    """How badly scans are aligned, from 0 to 1 without any overlap: what to compare networks by, not to descend.

    The losses fall again where scans are so far apart that hardly a pixel is believed or used. This is what
    `GaussNewton.agreement` is to a registration: the share of the used pixels that do not fit, and more where they are
    few.

    Args:
        residuals: point-to-plane distances [m].
        used: pixels of the reference with a point of the target.
        defined: pixels of the reference with a normal.
    """
    fit = (used * torch.exp(-((residuals / _FIT_RESIDUAL_M) ** 2))).sum(dim=(1, 2))
    return (1 - fit / (used.sum(dim=(1, 2)) + _FEW * defined.sum(dim=(1, 2))).clamp(min=1)).mean()


def reproject(
    T_ref_new: Float[Tensor, "batch 4 4"],
    target: Float[Tensor, "batch 3 h w"],
    projection: SphericalProjection,
) -> Float[Tensor, "batch 3 h w"]:
    """The target's points in the reference frame, in the pixels where the reference would see them."""
    with torch.no_grad():
        points = se3.transform_map(T_ref_new, target)
        # Empty pixels are zeros; transformed they would become points, back at the origin they fall into no pixel.
        points = torch.where(activated(target)[:, None], points, 0.0)
        nearest = projection.nearest_points(points.flatten(2).mT)[:, None]
    # Chosen first and transformed then, once more: so no gradient has to find its way back to where a point came from.
    chosen = target.flatten(2).gather(-1, nearest.clamp(min=0).flatten(2).expand(-1, 3, -1)).view_as(target)
    return torch.where(nearest >= 0, se3.transform_map(T_ref_new, chosen), 0.0)
