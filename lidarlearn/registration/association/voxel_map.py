"""The last k scans aggregated, one point per voxel, with normals that grow with the map.

A table maps voxels to points: a point lives for k scans, an occupied voxel takes no second one meanwhile.
"""

import functools
import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from lidarlearn import cuda_graphs
from lidarlearn.errors import require_positive
from lidarlearn.geometry.normals import fit_planes
from lidarlearn.geometry.voxels import grid_sample, voxel_cells
from lidarlearn.registration.association.point_buffer import PointBuffer

# The table wraps around in space: two voxels share an entry only if they are 512 (512, 64) cells apart, 205 m (26 m) at
# 0.4 m, so neighbours never collide and stand side by side in memory. Of two points that share one, 7 of 97,000 on a
# motorway, the later is found.
_TABLE_BITS = (9, 9, 6)
_PADDING = cuda_graphs.Padding(least=1 << 12)  # with points that are none
_MIN_NEIGHBOURS = 5
_MAX_ROUGHNESS = 0.5  # deviation from the plane over the smaller extent in it
_MIN_EXTENT = 0.15  # smaller extent in the plane over the voxel size: a line of points, as of one beam, has no normal


class VoxelMap(PointBuffer):
    """A growing and forgetting point cloud with one point per voxel, its normals kept up incrementally.

    Each point carries the moments of the points that were ever seen in the 26 voxels around it, while it lives. A new
    point adds itself to the moments of its neighbours, so a normal costs work only when its neighbourhood changes; what
    is forgotten stays in them: it lay on the same surface.

    Args:
        voxel_size_m: edge of the voxels [m].
        device: where the points are kept.

    Source: Dellenbach et al. 2021, III-A "Local map and neighborhood"; the hashed grid after Niessner et al. 2013.
    """

    def __init__(self, voxel_size_m: float, device: torch.device) -> None:
        require_positive("association", voxel_size_m=voxel_size_m)
        self.voxel_size_m = voxel_size_m
        super().__init__(device)
        # One more, for what is no point.
        self._table = torch.full(((1 << sum(_TABLE_BITS)) + 1,), -1, dtype=torch.int32, device=device)

    def insert(self, points_world: Float[Tensor, "n 3"], frames: int) -> None:
        """Add the points that fall into free voxels as one scan; keep the last `frames` scans."""
        self.forget(frames - 1)
        is_free = self._recorded(self._is_free, points_world)
        points_world = points_world[is_free[: len(points_world)]]
        points_world = points_world[grid_sample(points_world, self.voxel_size_m, self.recordings)]
        count = len(points_world)
        padding = _PADDING.length(count) - count if cuda_graphs.are_used_on(self._device) else 0
        new, _ = self._allocate(count, spare=padding)
        self._recorded(self._add, points_world, torch.tensor(new.start))

    def _recorded(self, function: Callable[..., Any], *inputs: Tensor) -> Any:
        return self.recordings(function, *inputs, device=self._device, settings=function.__name__, padding=_PADDING)

    def _is_free(self, points_world: Float[Tensor, "n 3"]) -> Bool[Tensor, "n"]:
        return self.lookup(voxel_cells(points_world, self.voxel_size_m)) < 0

    def lookup(self, cells: Int[Tensor, "*batch 3"]) -> Int[Tensor, "*batch"]:
        """Index into `points` of the point in each voxel, -1 where there is none."""
        index = self._table[_entries(cells)]
        alive = index >= self.origin
        same = (self._cells[index.clamp(min=0)] == cells).all(dim=-1)
        return torch.where(alive & same, index - self.origin, -1).long()

    def around(self, points_world: Float[Tensor, "m 3"], radius: int, inner: int = -1) -> Int[Tensor, "m c"]:
        """Candidates for the neighbours of each point: what stands in the voxels up to so many steps from its own.

        Args:
            points_world: points [m], in the map's frame.
            radius: how many steps along each axis.
            inner: voxels up to this number of steps away are left out.

        Returns:
            Slots. An empty voxel, or one whose entry another voxel took, gives a point from anywhere:
            distances tell them apart, which is cheaper than to compare voxels.
        """
        cells = voxel_cells(points_world, self.voxel_size_m)
        return self._candidates(cells, radius, inner).clamp_(min=self.origin)

    def reached(self, points_world: Float[Tensor, "m 3"], reach_m: float) -> Int[Tensor, "m c"]:
        """The same in all voxels that are not farther than a distance from each point, and hardly any more."""
        first = voxel_cells(points_world - reach_m, self.voxel_size_m)
        steps = torch.arange(voxels_reached(reach_m, self.voxel_size_m), dtype=torch.int32, device=self._device)
        return self._table_at(first, steps).clamp_(min=self.origin)

    def _candidates(self, cells: Int[Tensor, "m 3"], radius: int, inner: int = -1) -> Int[Tensor, "m c"]:
        """What the table says of the voxels in a cube around each voxel, as `_cube` lists them."""
        steps = torch.arange(-radius, radius + 1, dtype=torch.int32, device=self._device)
        used = _cube(radius, self._device).abs().amax(dim=1) > inner if inner >= 0 else None
        return self._table_at(cells, steps, used)

    def _table_at(
        self, cells: Int[Tensor, "m 3"], steps: Int[Tensor, "k"], used: Bool[Tensor, "cube"] | None = None
    ) -> Int[Tensor, "m c"]:
        """What the table says of the voxels so many steps from each voxel along all axes, z fastest."""
        x, y, z = (_axis_entries(cells[:, axis, None] + steps, axis) for axis in range(3))
        entries = (x[:, :, None, None] | y[:, None, :, None] | z[:, None, None, :]).flatten(1)
        if used is not None:
            entries = entries[:, used]
        return self._table.index_select(0, entries.flatten()).view_as(entries)

    def _add(self, points_world: Float[Tensor, "m 3"], first: Int[Tensor, ""]) -> None:
        """Write points to their slots, from the first on, and let them and their neighbours count each other.

        A point that is NaN is none: it is written behind the others, where nothing is yet.
        """
        new = first + torch.arange(len(points_world), device=self._device)
        cells = voxel_cells(points_world, self.voxel_size_m)
        self.slot_coordinates.index_copy_(1, new, points_world.mT)
        self._cells.index_copy_(0, new, cells)
        self._moments.index_fill_(0, new, 0)
        is_point = points_world[:, 0].isfinite()
        self._table[torch.where(is_point, _entries(cells), len(self._table) - 1)] = new.int()
        pairs = self._pairs(cells, is_point)
        offsets = self.slot_coordinates[:, pairs.old] - points_world.mT[:, pairs.new]
        one = pairs.count.to(offsets)
        x, y, z = torch.where(pairs.count, offsets, 0.0)
        squares = (x * x, x * y, x * z, y * y, y * z, z * z)
        self._moments.index_add_(0, new[pairs.new], torch.stack([one, x, y, z, *squares], dim=1))
        # Pairs of new points occur twice, once from each side.
        mirrored = torch.stack([one, -x, -y, -z, *squares], dim=1) * (pairs.old < first)[:, None]
        self._moments.index_add_(0, pairs.old, mirrored)
        self._fit(torch.cat([pairs.old, new]))

    def _pairs(self, cells: Int[Tensor, "m 3"], is_point: Bool[Tensor, "m"]) -> "_Pairs":
        """New points, just entered into the table, and the points in the 26 voxels around each of them."""
        candidates = self._candidates(cells, 1)
        occupied = candidates >= self.origin
        if cuda_graphs.are_used_on(self._device):  # which does not ask how many there are
            new = torch.arange(len(cells), device=self._device)[:, None].expand_as(candidates).flatten()
            old, occupied = candidates.clamp_(min=self.origin).flatten().long(), occupied.flatten()
        else:
            new, column = occupied.nonzero(as_tuple=True)
            old, occupied = candidates[new, column].long(), occupied[new, column]
        offsets = self._cells[old] - cells[new]
        # An entry may be another voxel's.
        near = (offsets.abs().amax(dim=1) <= 1) & (offsets != 0).any(dim=1) & occupied & is_point[new]
        pairs = _Pairs(new, old, near)
        return pairs if cuda_graphs.are_used_on(self._device) else pairs.counted()

    def _fit(self, index: Int[Tensor, "m"]) -> None:
        """Fit planes to slots in the buffers; where nothing has changed nothing does."""
        if not cuda_graphs.are_used_on(self._device):
            index = self._once(index)
        moments = self._moments[index]
        n = moments[:, :1] + 1  # the point itself, at offset zero
        mx, my, mz = (moments[:, 1:4] / n).unbind(-1)
        outer = torch.stack([mx * mx, mx * my, mx * mz, my * my, my * mz, mz * mz], dim=1)
        plane = fit_planes(moments[:, 4:] / n - outer)
        smallest_extent = _MIN_EXTENT * self.voxel_size_m
        self._normals[index] = plane.normals * _is_plane(moments[:, 0], plane.variances, smallest_extent)[:, None]

    def _once(self, index: Int[Tensor, "m"]) -> Int[Tensor, "k"]:
        """Each of the slots once."""
        occurs = torch.zeros(self._end - self._start, dtype=torch.bool, device=self._device)
        occurs[index - self._start] = True
        return occurs.nonzero()[:, 0] + self._start

    def _move_to_front(self, needed: int) -> None:
        super()._move_to_front(needed)
        self._table.fill_(-1)
        living = self._cells[: self._end]
        self._table[_entries(living)] = torch.arange(len(living), dtype=torch.int32, device=self._device)

    def _buffers(self) -> tuple[Tensor, ...]:
        return *super()._buffers(), self._cells, self._moments

    def _reserve(self, capacity: int) -> None:
        super()._reserve(capacity)
        self._cells = torch.empty(capacity, 3, dtype=torch.int32, device=self._device)
        self._moments = torch.empty(capacity, 10, device=self._device)


def neighbourhood_normals(points: Float[Tensor, "n 3"], voxel_size_m: float) -> Float[Tensor, "n 3"]:
    """Normals of a scan's points from the points in the voxels around each, zero where they span no plane."""
    surface = VoxelMap(voxel_size_m, points.device)
    surface.insert(points, frames=1)
    index = surface.lookup(voxel_cells(points, voxel_size_m))
    return torch.where((index >= 0)[:, None], surface.normals[index.clamp(min=0)], 0.0)


def voxels_reached(reach_m: float, voxel_size_m: float) -> int:
    """How many voxels in a row are at most that far from a point on either side."""
    return math.ceil(round(2 * reach_m / voxel_size_m, 6)) + 1


@dataclass(frozen=True)
class _Pairs:
    """Pairs of neighbours: which of the new points, which slot in the buffers, and whether the pair counts."""

    new: Int[Tensor, "p"]
    old: Int[Tensor, "p"]
    count: Bool[Tensor, "p"]

    def counted(self) -> "_Pairs":
        """Those that count."""
        return _Pairs(self.new[self.count], self.old[self.count], self.count[self.count])


@functools.cache
def _cube(radius: int, device: torch.device) -> Int[Tensor, "n 3"]:
    """Offsets of all cells of the cube of edge 2 radius + 1 around a cell, itself included, z fastest."""
    steps = torch.arange(-radius, radius + 1, device=device)
    return torch.cartesian_prod(steps, steps, steps)


def _is_plane(
    neighbours: Float[Tensor, "m"], variances: Float[Tensor, "m 3"], smallest_extent_m: float
) -> Bool[Tensor, "m"]:
    across, along = variances[:, 0], variances[:, 1]
    extended = along >= smallest_extent_m**2
    return (neighbours >= _MIN_NEIGHBOURS) & extended & (across <= _MAX_ROUGHNESS**2 * along)


def _entries(cells: Int[Tensor, "*batch 3"]) -> Int[Tensor, "*batch"]:
    x, y, z = (_axis_entries(cells[..., axis], axis) for axis in range(3))
    return x | y | z


def _axis_entries(cells: Int[Tensor, "*batch"], axis: int) -> Int[Tensor, "*batch"]:
    """The part of a table index that comes from one coordinate."""
    return (cells & ((1 << _TABLE_BITS[axis]) - 1)) << sum(_TABLE_BITS[axis + 1 :])
