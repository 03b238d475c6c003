"""A map of the last scans with one point per voxel, and normals that are updated incrementally.

A hash table maps voxels to points. A point is kept for k scans, in which its voxel accepts no other.
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
from lidarlearn.geometry.normals import covariances_of, fit_planes
from lidarlearn.geometry.voxels import grid_sample, voxel_cells
from lidarlearn.registration.association.point_buffer import PointBuffer

# The table wraps around in space: two voxels share an entry only if they are 512 (512, 64) voxels apart, 205 m (26 m)
# at 0.4 m. So neighbouring voxels never collide, and their entries are close in memory. Of two points that share an
# entry, as 7 of 97,000 do on a motorway, the later one is found.
_TABLE_BITS = (9, 9, 6)
_PADDING = cuda_graphs.Padding(step=1 << 12)  # with NaN, which marks padding
_MIN_NEIGHBOURS = 5
_MAX_ROUGHNESS = 0.5  # deviation from the plane, relative to the smaller extent in it
_MIN_EXTENT = 0.15  # smaller extent in the plane, relative to the voxel size: a line of points has no normal


class VoxelMap(PointBuffer):
    """A point buffer with at most one point per voxel, and normals from the voxels around each point.

    Each point keeps the moments of all points that were in the 26 voxels around it during its stay. A new point adds
    itself to the moments of its neighbours, so a normal costs work only when its neighbourhood changes. Forgotten
    points are not subtracted: they lay on the same surface.

    Args:
        voxel_size_m: edge of the voxels [m].
        device: where the points are kept.

    Source: Dellenbach et al. 2021, III-A "Local map and neighborhood"; the hashed grid after Niessner et al. 2013.
    """

    def __init__(self, voxel_size_m: float, device: torch.device) -> None:
        require_positive("association", voxel_size_m=voxel_size_m)
        self.voxel_size_m = voxel_size_m
        super().__init__(device)
        # The last entry takes the padding.
        self._table = torch.full(((1 << sum(_TABLE_BITS)) + 1,), -1, dtype=torch.int32, device=device)

    def insert(self, points_world: Float[Tensor, "n 3"], frames: int) -> None:
        """Add the points that fall into free voxels as one scan; keep the last `frames` scans."""
        self.forget(frames - 1)
        is_free = self._in_graph(self._is_free, points_world)
        points_world = points_world[is_free[: len(points_world)]]
        points_world = points_world[grid_sample(points_world, self.voxel_size_m, self.graphs)]
        count = len(points_world)
        padding = _PADDING.length(count) - count if cuda_graphs.supported_on(self._device) else 0
        new, _ = self._allocate(count, spare=padding)
        self._in_graph(self._add, points_world, torch.tensor(new.start))

    def _in_graph(self, function: Callable[..., Any], *inputs: Tensor) -> Any:
        return self.graphs(function, *inputs, device=self._device, settings=function.__name__, padding=_PADDING)

    def _is_free(self, points_world: Float[Tensor, "n 3"]) -> Bool[Tensor, "n"]:
        return self.lookup(voxel_cells(points_world, self.voxel_size_m)) < 0

    def lookup(self, cells: Int[Tensor, "*batch 3"]) -> Int[Tensor, "*batch"]:
        """Index into `points` of the point in each voxel, -1 where there is none."""
        index = self._table[_entries(cells)]
        alive = index >= self.origin
        same = (self._cells[index.clamp(min=0)] == cells).all(dim=-1)
        return torch.where(alive & same, index - self.origin, -1).long()

    def around(self, points_world: Float[Tensor, "m 3"], radius: int, inner: int = -1) -> Int[Tensor, "m c"]:
        """Candidates for the neighbours of each point: the points in a cube of voxels around its own.

        Args:
            points_world: points [m], in the map's frame.
            radius: number of voxels between the central one and the faces of the cube.
            inner: `radius` of a smaller cube that is left out; -1: none.

        Returns:
            Slots. An empty voxel, or one whose entry belongs to another voxel, gives an arbitrary point: comparing
            distances is cheaper than comparing voxels.
        """
        cells = voxel_cells(points_world, self.voxel_size_m)
        return self._candidates(cells, radius, inner).clamp_(min=self.origin)

    def reached(self, points_world: Float[Tensor, "m 3"], reach_m: float) -> Int[Tensor, "m c"]:
        """Candidates in all voxels within a distance of each point, and few others; slots as from `around`."""
        first = voxel_cells(points_world - reach_m, self.voxel_size_m)
        steps = torch.arange(voxels_reached(reach_m, self.voxel_size_m), dtype=torch.int32, device=self._device)
        return self._table_at(first, steps).clamp_(min=self.origin)

    def _candidates(self, cells: Int[Tensor, "m 3"], radius: int, inner: int = -1) -> Int[Tensor, "m c"]:
        """Table entries of a cube of voxels around each voxel, in the order of `_cube`."""
        steps = torch.arange(-radius, radius + 1, dtype=torch.int32, device=self._device)
        used = _cube(radius, self._device).abs().amax(dim=1) > inner if inner >= 0 else None
        return self._table_at(cells, steps, used)

    def _table_at(
        self, cells: Int[Tensor, "m 3"], steps: Int[Tensor, "k"], used: Bool[Tensor, "cube"] | None = None
    ) -> Int[Tensor, "m c"]:
        """Table entries of the voxels at all combinations of steps along the axes from each voxel, z fastest."""
        x, y, z = (_axis_entries(cells[:, axis, None] + steps, axis) for axis in range(3))
        entries = (x[:, :, None, None] | y[:, None, :, None] | z[:, None, None, :]).flatten(1)
        if used is not None:
            entries = entries[:, used]
        return self._table.index_select(0, entries.flatten()).view_as(entries)

    def _add(self, points_world: Float[Tensor, "m 3"], first: Int[Tensor, ""]) -> None:
        """Write points to consecutive slots, and add them and their neighbours to each other's moments.

        NaN is padding, not a point: it comes last and is written to free slots.
        """
        new = first + torch.arange(len(points_world), device=self._device)
        cells = voxel_cells(points_world, self.voxel_size_m)
        self.slot_coordinates.index_copy_(1, new, points_world.mT)
        self._cells.index_copy_(0, new, cells)
        self._moments.index_fill_(0, new, 0)
        is_point = points_world[:, 0].isfinite()
        self._table[torch.where(is_point, _entries(cells), len(self._table) - 1)] = new.int()
        pairs = self._pairs(cells, is_point)
        offsets = self.slot_coordinates[:, pairs.neighbour] - points_world.mT[:, pairs.new]
        count = pairs.is_valid.to(offsets)
        x, y, z = torch.where(pairs.is_valid, offsets, 0.0)
        squares = (x * x, x * y, x * z, y * y, y * z, z * z)
        self._moments.index_add_(0, new[pairs.new], torch.stack([count, x, y, z, *squares], dim=1))
        # Pairs of two new points occur twice, once from each side.
        mirrored = torch.stack([count, -x, -y, -z, *squares], dim=1) * (pairs.neighbour < first)[:, None]
        self._moments.index_add_(0, pairs.neighbour, mirrored)
        self._fit(torch.cat([pairs.neighbour, new]))

    def _pairs(self, cells: Int[Tensor, "m 3"], is_point: Bool[Tensor, "m"]) -> "_Pairs":
        """Pairs of a new point, already in the table, and a point in one of the 26 voxels around it."""
        candidates = self._candidates(cells, 1)
        occupied = candidates >= self.origin
        if cuda_graphs.supported_on(self._device):  # without reading the number of pairs
            new = torch.arange(len(cells), device=self._device)[:, None].expand_as(candidates).flatten()
            neighbour, occupied = candidates.clamp_(min=self.origin).flatten().long(), occupied.flatten()
        else:
            new, column = occupied.nonzero(as_tuple=True)
            neighbour, occupied = candidates[new, column].long(), occupied[new, column]
        offsets = self._cells[neighbour] - cells[new]
        # An entry may belong to another voxel.
        is_near = (offsets.abs().amax(dim=1) <= 1) & (offsets != 0).any(dim=1) & occupied & is_point[new]
        pairs = _Pairs(new, neighbour, is_near)
        return pairs if cuda_graphs.supported_on(self._device) else pairs.valid()

    def _fit(self, slots: Int[Tensor, "m"]) -> None:
        """Update the normals of some slots from their moments."""
        if not cuda_graphs.supported_on(self._device):
            slots = self._distinct(slots)
        moments = self._moments[slots]
        n = moments[:, :1] + 1  # the point itself, at offset zero
        plane = fit_planes(covariances_of(moments[:, 1:4] / n, moments[:, 4:] / n))
        smallest_extent = _MIN_EXTENT * self.voxel_size_m
        self._normals[slots] = plane.normals * _is_plane(moments[:, 0], plane.variances, smallest_extent)[:, None]

    def _distinct(self, slots: Int[Tensor, "m"]) -> Int[Tensor, "k"]:
        """The distinct slots among these."""
        occurs = torch.zeros(self._end - self._start, dtype=torch.bool, device=self._device)
        occurs[slots - self._start] = True
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
    """Normals of a scan's points from the voxels around each, zero where their points span no plane."""
    surface = VoxelMap(voxel_size_m, points.device)
    surface.insert(points, frames=1)
    index = surface.lookup(voxel_cells(points, voxel_size_m))
    return torch.where((index >= 0)[:, None], surface.normals[index.clamp(min=0)], 0.0)


def voxels_reached(reach_m: float, voxel_size_m: float) -> int:
    """The largest number of voxels in a row that are within a distance on either side of a point."""
    return math.ceil(round(2 * reach_m / voxel_size_m, 6)) + 1


@dataclass(frozen=True)
class _Pairs:
    """Pairs of neighbours.

    Args:
        new: index of a new point.
        neighbour: slot of its neighbour.
        is_valid: whether they are neighbours.
    """

    new: Int[Tensor, "p"]
    neighbour: Int[Tensor, "p"]
    is_valid: Bool[Tensor, "p"]

    def valid(self) -> "_Pairs":
        """Only the valid pairs."""
        return _Pairs(self.new[self.is_valid], self.neighbour[self.is_valid], self.is_valid[self.is_valid])


@functools.cache
def _cube(radius: int, device: torch.device) -> Int[Tensor, "n 3"]:
    """Offsets of the voxels of a cube of edge 2 radius + 1 from its centre, z fastest."""
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
    """The part of the table index that comes from one coordinate."""
    return (cells & ((1 << _TABLE_BITS[axis]) - 1)) << sum(_TABLE_BITS[axis + 1 :])
