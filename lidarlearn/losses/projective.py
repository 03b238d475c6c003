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

_FIT_SCALE_M = 0.1  # residual at which a pixel fits by 1/e: far below a motion, far above noise
_SMALL_OVERLAP = 0.1  # share of the reference's pixels below which an overlap is too small to trust its fit


class ProjectiveLoss(nn.Module, ABC):
    """L(T_ref_new) = 1/n_k sum rho over the n_k pixels activated in the reference and in the reprojected target.

    The target is transformed by the estimate and projected into the reference. Each of its points corresponds to the
    reference point in its pixel, with that point's normal; neither precomputed normals nor a KdTree are needed. The
    mean is taken over each pair of the batch first, so that all pairs weigh the same whatever their overlap. A pair
    without overlap has zero loss and zero gradient.

    Subclasses define the cost of one correspondence, `rho`.

    Args:
        normal_window: rows and columns of the neighbourhood of reference normals [px], odd.
        max_range_jump: see `normal_map`; the fewer rows an image has, the larger the range steps between them.
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
            residuals: signed distance of each target point to the plane of its reference point [m].
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
            projection: of both vertex maps.
        """
        aligned = reproject(se3.from_euler(parameters), target, projection)
        with torch.no_grad():
            normals = self.normals(reference)
            defined = activated(normals)  # implies that the pixel itself is activated
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
        """Normals of a vertex map with the settings of this loss, zero where undefined."""
        return normal_map(reference, self.normal_window, self.max_range_jump, self.max_roughness)


def misfit(
    residuals: Float[Tensor, "batch h w"], used: Bool[Tensor, "batch h w"], defined: Bool[Tensor, "batch h w"]
) -> Float[Tensor, ""]:
    """How badly scans are aligned, from 0 to 1 (no overlap); for comparing networks, not for training them.

    The losses cannot compare networks: they fall again once scans are so far apart that hardly any pixels are used or
    have weight. This is the share of the used pixels that do not fit, increased if they are few, as
    `GaussNewton.agreement` is for registrations.

    Args:
        residuals: point-to-plane distances [m].
        used: pixels with a reference normal and a target point.
        defined: pixels with a reference normal.
    """
    fit = (used * torch.exp(-((residuals / _FIT_SCALE_M) ** 2))).sum(dim=(1, 2))
    return (1 - fit / (used.sum(dim=(1, 2)) + _SMALL_OVERLAP * defined.sum(dim=(1, 2))).clamp(min=1)).mean()


def reproject(
    T_ref_new: Float[Tensor, "batch 4 4"],
    target: Float[Tensor, "batch 3 h w"],
    projection: SphericalProjection,
) -> Float[Tensor, "batch 3 h w"]:
    """The target's points in the reference frame, each in the pixel where the reference sensor would see it."""
    with torch.no_grad():
        points = se3.transform_map(T_ref_new, target)
        # Empty pixels are zeros, which the transform turns into points; points at the origin fall into no pixel.
        points = torch.where(activated(target)[:, None], points, 0.0)
        nearest = projection.nearest_points(points.flatten(2).mT)[:, None]
    # Gathered before they are transformed again: the backward pass needs no scatter to the pixels they came from.
    chosen = target.flatten(2).gather(-1, nearest.clamp(min=0).flatten(2).expand(-1, 3, -1)).view_as(target)
    return torch.where(nearest >= 0, se3.transform_map(T_ref_new, chosen), 0.0)
