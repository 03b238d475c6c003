"""Voxel grids: integer cells of points, one point per cell, and sums over the points of a cell."""

import functools
import math

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from lidarlearn import cuda_graphs


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


def grid_sample(
    points: Float[Tensor, "n 3"], voxel_size_m: float, recordings: cuda_graphs.Recordings | None = None
) -> Int[Tensor, "m"]:
    """Indices of one point of every occupied voxel, drawn by lot, in the order of the voxels.

    Deterministic, yet blind to the order of the scan: a spinning LiDAR lists its points beam by beam, and the first
    point of each voxel would stand on the same side of all of them, which a registration follows. In the order of the
    voxels, neighbours in space are neighbours in memory, too, which makes searching among them faster.

    Args:
        points: the scan [m].
        voxel_size_m: edge of the voxels [m].
        recordings: where a GPU records this, for whoever asks for it scan by scan.

    Source: Dellenbach et al. 2021, IV-A: 0.4 m for Kd-F2M.
    """
    if recordings is not None and cuda_graphs.are_used_on(points.device):
        return _recorded_grid_sample(points, voxel_size_m, recordings)
    lots = _permutation(len(points), points.device)
    _, order, begins = _sorted(voxel_keys(voxel_cells(points, voxel_size_m)).index_select(0, lots))
    return lots[order[begins]]


def _recorded_grid_sample(
    points: Float[Tensor, "n 3"], voxel_size_m: float, recordings: cuda_graphs.Recordings
) -> Int[Tensor, "m"]:
    """The same, asking only once for a size."""
    as_many_as_lots = cuda_graphs.Padding(to_power_of_two=True)
    sample = functools.partial(_sample, voxel_size_m=voxel_size_m)
    settings = ("grid_sample", voxel_size_m)
    index, begins = recordings(sample, points, device=points.device, settings=settings, padding=as_many_as_lots)
    return index[begins]


def _sample(points: Float[Tensor, "n 3"], voxel_size_m: float) -> tuple[Int[Tensor, "n"], Bool[Tensor, "n"]]:
    """What `grid_sample` chooses from, and which of it, without asking how far the points reach; NaN is no point.

    Cells are taken to lie within a million of the origin.
    """
    lots = _permutation(len(points), points.device)
    x, y, z = ((axis.long() + (1 << 20)) & 0x1FFFFF for axis in voxel_cells(points, voxel_size_m).unbind(-1))
    nothing = torch.iinfo(torch.int64).max
    keys = torch.where(points[:, 0].isfinite(), (x << 42) | (y << 21) | z, nothing)
    keys, order, begins = _sorted(keys.index_select(0, lots))
    return lots[order], begins & (keys < nothing)


def _sorted(keys: Int[Tensor, "n"]) -> tuple[Int[Tensor, "n"], Int[Tensor, "n"], Bool[Tensor, "n"]]:
    """The keys in ascending order, where each stood, and whether it is another one than that before it."""
    keys, order = torch.sort(keys, stable=True)
    begins = torch.ones_like(keys, dtype=torch.bool)
    torch.ne(keys[1:], keys[:-1], out=begins[1:])
    return keys, order, begins


class VoxelSums:
    """Sums over the points of each voxel, of points that come in parts; the memory goes by the voxels, not the points.

    What is new waits, summed part by part, until it is as much as the voxels there are: merging then costs each voxel
    no more than a few sorts, however many parts there come.

    Args:
        columns: how many values of a point are summed.
        dtype: of the sums.
    """

    _MIN_WAITING = 1 << 20

    def __init__(self, columns: int, dtype: torch.dtype = torch.float32) -> None:
        merged = (torch.zeros(0, 3, dtype=torch.int32), torch.zeros(0, columns, dtype=dtype))
        self._parts: list[tuple[Tensor, Tensor]] = [merged]

    def add(self, cells: Int[Tensor, "n 3"], values: Float[Tensor, "n c"]) -> None:
        """Count in points by the voxels that hold them."""
        self._parts.append(_summed(cells, values))
        merged, *waiting = (len(cells) for cells, _ in self._parts)
        if sum(waiting) > max(self._MIN_WAITING, merged):
            self.result()

    def result(self) -> tuple[Int[Tensor, "m 3"], Float[Tensor, "m c"]]:
        """The voxels that hold a point, ordered by x, then y, then z, and their sums."""
        if len(self._parts) > 1:
            cells, sums = (torch.cat(parts) for parts in zip(*self._parts, strict=True))
            self._parts = [_summed(cells, sums)]
        return self._parts[0]


def _summed(cells: Int[Tensor, "n 3"], values: Float[Tensor, "n c"]) -> tuple[Int[Tensor, "m 3"], Float[Tensor, "m c"]]:
    """The voxels, each once, and the sums of the values that stand in it."""
    keys, voxel = torch.unique(voxel_keys(cells), return_inverse=True)
    once = torch.empty(len(keys), 3, dtype=cells.dtype)
    once[voxel] = cells  # all that share a voxel are alike
    return once, values.new_zeros(len(keys), values.shape[1]).index_add_(0, voxel, values)


def _permutation(n: int, device: torch.device) -> Int[Tensor, "n"]:
    """The numbers from 0 to n - 1 in an order drawn once and for all."""
    lots = _shuffled(max(n - 1, 1).bit_length(), device)
    return lots if n == len(lots) else lots.index_select(0, (lots < n).nonzero()[:, 0])


@functools.cache
def _shuffled(bits: int, device: torch.device) -> Int[Tensor, "m"]:
    return torch.randperm(1 << bits, generator=torch.Generator().manual_seed(0)).to(device)
