"""Spherical projection of a scan into an image, one nearest point per pixel."""

import math
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from lidarlearn.geometry.ranges import squared_ranges

_NO_POINT = torch.iinfo(torch.int64).max  # its lower half is -1


@dataclass(frozen=True)
class SphericalProjection:
    """The image of a spinning LiDAR: rows are elevations, columns azimuths that wrap at the seam behind the sensor.

    column = (1 - atan2(y, x)/pi)/2 * width; row = (fov_up - asin(z/r)) / (fov_up - fov_down) * height.

    Args:
        height: rows [px].
        width: columns [px].
        fov_up_deg: elevation of the upper image border, above the horizon positive [deg].
        fov_down_deg: elevation of the lower image border [deg].

    Source: Dellenbach et al. 2021, III-A "Local map and neighborhood": 64x720 px for the HDL-64.
    """

    height: int = 64
    width: int = 720
    fov_up_deg: float = 3.0
    fov_down_deg: float = -24.0

    def __post_init__(self) -> None:
        if self.height < 1 or self.width < 1 or self.fov_up_deg <= self.fov_down_deg:
            raise ValueError(f"a projection needs height, width >= 1 and fov_up_deg > fov_down_deg, got {self}")

    @property
    def pixels(self) -> int:
        """Number of pixels of the image."""
        return self.height * self.width

    def pixel_index(self, points: Float[Tensor, "*batch n 3"]) -> Int[Tensor, "*batch n"]:
        """The pixel of each point, row * width + column as int32; -1 outside the field of view, at the origin, for NaN.

        Infinite points are not supported; odometries and readers drop them.
        """
        # Axis by axis, in place, in 32 bits: a map of a million points is projected at memory speed.
        x, y, z = coordinates = points.detach().movedim(-1, 0).contiguous()
        ranges = squared_ranges(coordinates.movedim(0, -1)).sqrt_()
        column = torch.atan2(y, x).mul_(-self.width / (2 * math.pi)).add_(self.width / 2).int()
        column = torch.where(column < self.width, column, 0)
        fov_up, fov_down = math.radians(self.fov_up_deg), math.radians(self.fov_down_deg)
        row = torch.div(z, ranges).asin_().sub_(fov_up).mul_(-self.height / (fov_up - fov_down))
        inside = (row >= 0).logical_and_(row < self.height)  # false at the origin, which has no elevation
        return torch.where(inside, column.add_(row.int(), alpha=self.width), -1)

    def nearest_points(self, points: Float[Tensor, "*batch n 3"]) -> Int[Tensor, "*batch h w"]:
        """Index into `points` of the nearest point of each pixel, -1 where no point fell; see `nearest_per_bin`."""
        # An additional first bin holds the points outside the image.
        bins = self.pixel_index(points).add_(1)
        index = nearest_per_bin(bins, squared_ranges(points.detach().float()), self.pixels + 1)[..., 1:].long()
        return index.unflatten(-1, (self.height, self.width))

    def vertex_map(self, points: Float[Tensor, "*batch n 3"]) -> Float[Tensor, "*batch 3 h w"]:
        """Coordinates [m] of the nearest point of each pixel, zeros where no point fell; differentiable."""
        index = self.nearest_points(points).flatten(-2)
        if points.shape[-2] == 0:
            return points.new_zeros(*points.shape[:-2], 3, self.height, self.width)
        gathered = points.gather(-2, index.clamp(min=0)[..., None].expand(*index.shape, 3))
        filled = torch.where((index >= 0)[..., None], gathered, 0.0)
        return filled.mT.unflatten(-1, (self.height, self.width))


def nearest_per_bin(
    bins: Int[Tensor, "*batch n"], ranges: Float[Tensor, "*batch n"], count: int
) -> Int[Tensor, "*batch count"]:
    """Index of the point with the smallest range in each bin, -1 in empty bins; int32.

    Deterministic on every device: the minimum over (range, index), packed into one integer, does not depend on the
    order of execution. Of equal ranges the smaller index wins.

    Args:
        bins: bin of each point, from 0 to `count` - 1.
        ranges: range of each point, or its square; not negative.
        count: number of bins.
    """
    # Non-negative floats are ordered like their bits.
    keys = ranges.view(torch.int32).long().bitwise_left_shift_(32)
    keys += torch.arange(ranges.shape[-1], device=ranges.device)
    nearest = torch.full((*ranges.shape[:-1], count), _NO_POINT, device=ranges.device)
    return nearest.scatter_reduce_(-1, bins.long(), keys, "amin").int()  # the lower half


def activated(vertex_map: Float[Tensor, "*batch 3 h w"]) -> Bool[Tensor, "*batch h w"]:
    """Pixels with a point. Empty pixels are exactly zero in all three coordinates."""
    return (vertex_map != 0).any(dim=-3)
