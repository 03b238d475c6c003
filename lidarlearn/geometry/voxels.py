"""Voxel grids: integer cells of points, and one point per cell."""

import functools
import math

import torch
from jaxtyping import Float, Int
from torch import Tensor


def voxel_cells(points: Float[Tensor, "*batch 3"], voxel_size_m: float) -> Int[Tensor, "*batch 3"]:
    """Integer coordinates of the voxel that holds each point, of 32 bits, each coordinate in one piece of memory."""
    return torch.stack([(axis / voxel_size_m).floor_().int() for axis in points.unbind(-1)]).movedim(0, -1)


def voxel_keys(cells: Int[Tensor, "n 3"]) -> Int[Tensor, "n"]:
    """One integer per cell, different for different cells, of 32 bits where they suffice; ordered by x, then y, then z.

    The box around all cells may hold 2^63 of them.
    """
    if len(cells) == 0:
        return cells[:, 0]
    axes = cells.unbind(1)
    bounds = torch.stack([torch.stack(axis.aminmax()) for axis in axes]).cpu().tolist()
    _, ny, nz = edges = [highest - lowest + 1 for lowest, highest in bounds]
    dtype = torch.int32 if math.prod(edges) < 1 << 31 else torch.int64
    x, y, z = (axis.to(dtype) - lowest for axis, (lowest, _) in zip(axes, bounds, strict=True))
    return x.mul_(ny).add_(y).mul_(nz).add_(z)


def grid_sample(points: Float[Tensor, "n 3"], voxel_size_m: float) -> Int[Tensor, "m"]:
    """Indices of one point of every occupied voxel, drawn by lot, in the order of the voxels.

    Deterministic, yet blind to the order of the scan: a spinning LiDAR lists its points beam by beam, and the first
    point of each voxel would stand on the same side of all of them, which a registration follows. In the order of the
    voxels, neighbours in space are neighbours in memory, too, which makes searching among them faster.

    Source: Dellenbach et al. 2021, IV-A: 0.4 m for Kd-F2M.
    """
    lots = _lots(len(points), points.device)
    keys = voxel_keys(voxel_cells(points, voxel_size_m)).index_select(0, lots)
    keys, order = torch.sort(keys, stable=True)
    begins = torch.ones_like(keys, dtype=torch.bool)
    torch.ne(keys[1:], keys[:-1], out=begins[1:])
    return lots[order[begins]]


def _lots(n: int, device: torch.device) -> Int[Tensor, "n"]:
    """The numbers from 0 to n - 1 in an order drawn once and for all."""
    lots = _shuffled(max(n - 1, 1).bit_length(), device)
    return lots.index_select(0, (lots < n).nonzero()[:, 0])


@functools.cache
def _shuffled(bits: int, device: torch.device) -> Int[Tensor, "m"]:
    return torch.randperm(1 << bits, generator=torch.Generator().manual_seed(0)).to(device)
