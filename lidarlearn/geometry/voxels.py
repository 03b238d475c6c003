"""Voxel grids: integer cells of points, and one point per cell."""

import torch
from jaxtyping import Float, Int
from torch import Tensor


def voxel_cells(points: Float[Tensor, "*batch 3"], voxel_size_m: float) -> Int[Tensor, "*batch 3"]:
    """Integer coordinates of the voxel that holds each point."""
    return (points / voxel_size_m).floor().long()


def voxel_keys(cells: Int[Tensor, "n 3"]) -> Int[Tensor, "n"]:
    """One integer per cell, different for different cells, of 32 bits where they suffice: sorting takes half the time.

    The box around all cells may hold 2^63 of them.
    """
    if len(cells) == 0:
        return cells[:, 0]
    cells = cells - cells.amin(dim=0)
    nx, ny, nz = (cells.amax(dim=0) + 1).tolist()
    keys = (cells[:, 0] * ny + cells[:, 1]) * nz + cells[:, 2]
    return keys.int() if nx * ny * nz < 1 << 31 else keys


def grid_sample(points: Float[Tensor, "n 3"], voxel_size_m: float) -> Int[Tensor, "m"]:
    """Indices, ascending, of one point of every occupied voxel, drawn by a hash of its index.

    Deterministic on every device, yet blind to the order of the scan: a spinning LiDAR lists its points beam by beam,
    and the first point of each voxel would stand on the same side of all of them, which a registration follows.

    Source: Dellenbach et al. 2021, IV-A: 0.4 m for Kd-F2M.
    """
    keys = voxel_keys(voxel_cells(points, voxel_size_m))
    unique, inverse = torch.unique(keys, return_inverse=True)
    index = torch.arange(len(points), device=points.device)
    priority = (_hash(index) << 32) | index
    drawn = priority.new_full((len(unique),), torch.iinfo(torch.int64).max)
    drawn.scatter_reduce_(0, inverse, priority, "amin")
    return (drawn & 0xFFFFFFFF).sort().values


def _hash(index: Int[Tensor, "n"]) -> Int[Tensor, "n"]:
    """31 bits that follow no order, unlike those of a multiplication alone. Source: Wellons' lowbias32, 2018."""
    h = ((index ^ (index >> 16)) * 0x7FEB352D) & 0xFFFFFFFF
    h = ((h ^ (h >> 15)) * 0x846CA68B) & 0xFFFFFFFF
    return (h ^ (h >> 16)) >> 1
