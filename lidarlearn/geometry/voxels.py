"""Voxel grids: integer cells of points, one point per cell, and sums over the points of a cell."""

import functools
import math

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from lidarlearn import cuda_graphs


def voxel_cells(points: Float[Tensor, "*batch 3"], voxel_size_m: float) -> Int[Tensor, "*batch 3"]:
    """Integer coordinates of each point's voxel, int32; each axis is contiguous in memory."""
    return torch.stack([(axis / voxel_size_m).floor_().int() for axis in points.unbind(-1)]).movedim(0, -1)


def voxel_keys(cells: Int[Tensor, "n 3"]) -> Int[Tensor, "n"]:
    """A unique integer for each cell, int32 if that suffices, else int64; ordered by x, then y, then z.

    The bounding box of the cells must contain fewer than 2^63 of them.
    """
    if len(cells) == 0:
        return cells[:, 0]
    axes = cells.unbind(1)
    bounds = torch.stack([torch.stack(axis.aminmax()) for axis in axes]).cpu().tolist()
    _, ny, nz = edges = [highest - lowest + 1 for lowest, highest in bounds]
    dtype = torch.int32 if math.prod(edges) < 1 << 31 else torch.int64
    x, y, z = (axis.to(dtype) - lowest for axis, (lowest, _) in zip(axes, bounds, strict=True))
    return x.mul_(ny).add_(y).mul_(nz).add_(z)


def grid_sample(
    points: Float[Tensor, "n 3"], voxel_size_m: float, graphs: cuda_graphs.GraphCache | None = None
) -> Int[Tensor, "m"]:
    """Index of one random point per occupied voxel, sorted by voxel.

    The permutation is fixed, so the result is deterministic, yet unrelated to the scan's order: a spinning LiDAR lists
    its points beam by beam, so the first points of all voxels would be on the same side, which biases a registration.
    Sorted by voxel, neighbours in space are close in memory, which makes searches faster.

    Args:
        points: the scan [m].
        voxel_size_m: edge of the voxels [m].
        graphs: keeps the CUDA graphs, for callers that sample scan after scan.

    Source: Dellenbach et al. 2021, IV-A: 0.4 m for Kd-F2M.
    """
    if graphs is not None and cuda_graphs.supported_on(points.device):
        return _grid_sample_in_graph(points, voxel_size_m, graphs)
    permutation = _permutation(len(points), points.device)
    _, order, is_first = _sorted(voxel_keys(voxel_cells(points, voxel_size_m)).index_select(0, permutation))
    return permutation[order[is_first]]


def _grid_sample_in_graph(
    points: Float[Tensor, "n 3"], voxel_size_m: float, graphs: cuda_graphs.GraphCache
) -> Int[Tensor, "m"]:
    """The same, waiting for the GPU only once."""
    padding = cuda_graphs.Padding(to_power_of_two=True)  # as long as the permutations
    sample = functools.partial(_sample, voxel_size_m=voxel_size_m)
    settings = ("grid_sample", voxel_size_m)
    index, is_first = graphs(sample, points, device=points.device, settings=settings, padding=padding)
    return index[is_first]


def _sample(points: Float[Tensor, "n 3"], voxel_size_m: float) -> tuple[Int[Tensor, "n"], Bool[Tensor, "n"]]:
    """Indices of the points sorted by voxel, and which of them `grid_sample` takes, without waiting for the GPU.

    NaN is padding, not a point. Points must be within a million voxels of the origin.
    """
    permutation = _permutation(len(points), points.device)
    x, y, z = ((axis.long() + (1 << 20)) & 0x1FFFFF for axis in voxel_cells(points, voxel_size_m).unbind(-1))
    nothing = torch.iinfo(torch.int64).max
    keys = torch.where(points[:, 0].isfinite(), (x << 42) | (y << 21) | z, nothing)
    keys, order, is_first = _sorted(keys.index_select(0, permutation))
    return permutation[order], is_first & (keys < nothing)


def _sorted(keys: Int[Tensor, "n"]) -> tuple[Int[Tensor, "n"], Int[Tensor, "n"], Bool[Tensor, "n"]]:
    """The keys in ascending order, the original index of each, and whether it is the first among equal keys."""
    keys, order = torch.sort(keys, stable=True)
    is_first = torch.ones_like(keys, dtype=torch.bool)
    torch.ne(keys[1:], keys[:-1], out=is_first[1:])
    return keys, order, is_first


class VoxelSums:
    """Sums over the points of each voxel, added part by part; memory grows with the voxels, not with the points.

    Each part is summed by voxel when added. The parts are merged once together they have as many voxels as the merged
    sums, so each voxel is sorted only a few times, however many parts there are.

    Args:
        columns: number of values per point.
        dtype: dtype of the sums.
    """

    _MIN_WAITING = 1 << 20  # voxels

    def __init__(self, columns: int, dtype: torch.dtype = torch.float32) -> None:
        merged = (torch.zeros(0, 3, dtype=torch.int32), torch.zeros(0, columns, dtype=dtype))
        self._parts: list[tuple[Tensor, Tensor]] = [merged]

    def add(self, cells: Int[Tensor, "n 3"], values: Float[Tensor, "n c"]) -> None:
        """Add the values of points to the sums of their voxels."""
        self._parts.append(_summed(cells, values))
        merged, *waiting = (len(cells) for cells, _ in self._parts)
        if sum(waiting) > max(self._MIN_WAITING, merged):
            self.result()

    def result(self) -> tuple[Int[Tensor, "m 3"], Float[Tensor, "m c"]]:
        """The occupied voxels, ordered by x, then y, then z, and their sums."""
        if len(self._parts) > 1:
            cells, sums = (torch.cat(parts) for parts in zip(*self._parts, strict=True))
            self._parts = [_summed(cells, sums)]
        return self._parts[0]


def _summed(cells: Int[Tensor, "n 3"], values: Float[Tensor, "n c"]) -> tuple[Int[Tensor, "m 3"], Float[Tensor, "m c"]]:
    """The distinct voxels and the sum of the values in each."""
    keys, voxel = torch.unique(voxel_keys(cells), return_inverse=True)
    once = torch.empty(len(keys), 3, dtype=cells.dtype)
    once[voxel] = cells  # equal for all points of a voxel
    return once, values.new_zeros(len(keys), values.shape[1]).index_add_(0, voxel, values)


def _permutation(n: int, device: torch.device) -> Int[Tensor, "n"]:
    """A fixed random permutation of 0 to n - 1."""
    longer = _power_of_two_permutation(max(n - 1, 1).bit_length(), device)
    return longer if n == len(longer) else longer.index_select(0, (longer < n).nonzero()[:, 0])


@functools.cache
def _power_of_two_permutation(bits: int, device: torch.device) -> Int[Tensor, "m"]:
    return torch.randperm(1 << bits, generator=torch.Generator().manual_seed(0)).to(device)
