"""Voxel grids: integer cells of points, and one point per cell."""

import math

import torch
from jaxtyping import Float, Int
from torch import Tensor


def voxel_cells(points: Float[Tensor, "*batch 3"], voxel_size_m: float) -> Int[Tensor, "*batch 3"]:
    """Integer coordinates of the voxel that holds each point."""
    return (points / voxel_size_m).floor().long()


def voxel_keys(cells: Int[Tensor, "n 3"]) -> Int[Tensor, "n"]:
    """One integer per cell, different for different cells, of 32 bits where they suffice.

    The box around all cells may hold 2^63 of them.
    """
    if len(cells) == 0:
        return cells[:, 0]
    axes = cells.unbind(1)
    bounds = torch.stack([torch.stack(axis.aminmax()) for axis in axes]).cpu().tolist()
    _, ny, nz = edges = [highest - lowest + 1 for lowest, highest in bounds]
    x, y, z = (axis - lowest for axis, (lowest, _) in zip(axes, bounds, strict=True))
    keys = x.mul_(ny).add_(y).mul_(nz).add_(z)
    return keys.int() if math.prod(edges) < 1 << 31 else keys


def grid_sample(points: Float[Tensor, "n 3"], voxel_size_m: float) -> Int[Tensor, "m"]:
    """Indices, ascending, of one point of every occupied voxel, drawn by a hash of its index.

    Deterministic on every device, yet blind to the order of the scan: a spinning LiDAR lists its points beam by beam,
    and the first point of each voxel would stand on the same side of all of them, which a registration follows.

    Source: Dellenbach et al. 2021, IV-A: 0.4 m for Kd-F2M.
    """
    keys = voxel_keys(voxel_cells(points, voxel_size_m))
    if keys.dtype != torch.int32:
        keys = torch.unique(keys, return_inverse=True)[1]
    # Voxel and hash in one integer: sorted, each voxel begins with the point that is drawn.
    drawn = _hash(torch.arange(len(points), device=points.device))
    ordered, index = torch.sort(drawn.bitwise_or_(keys.long().bitwise_left_shift_(32)))
    voxels = ordered.bitwise_right_shift_(32)
    begins = torch.ones_like(voxels, dtype=torch.bool)
    torch.ne(voxels[1:], voxels[:-1], out=begins[1:])
    return index[begins].sort().values


def _hash(index: Int[Tensor, "n"]) -> Int[Tensor, "n"]:
    """32 bits, different for different indices, that follow no order, unlike those of a multiplication alone.

    Source: Wellons' lowbias32, 2018.
    """
    for shift, factor in ((16, 0x7FEB352D), (15, 0x846CA68B)):
        index = (index >> shift).bitwise_xor_(index).mul_(factor).bitwise_and_(0xFFFFFFFF)
    return (index >> 16).bitwise_xor_(index)
