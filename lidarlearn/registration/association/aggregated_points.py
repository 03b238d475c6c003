"""The last k scans aggregated, one point per voxel, with normals that grow with the map.

A table maps voxels to points: a point lives for k scans, an occupied voxel takes no second one meanwhile.
"""

import functools

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from lidarlearn.geometry.normals import fit_planes
from lidarlearn.geometry.voxels import grid_sample, voxel_cells
from lidarlearn.registration.association.sliding_window import SlidingWindow

# The table wraps around in space: two voxels share a slot only if they are 512 (512, 64) cells apart, 205 m (26 m) at
# 0.4 m, so neighbours never collide and stand side by side in memory. Of two points that share one, 7 of 97,000 on a
# motorway, the later is found.
_TABLE_BITS = (9, 9, 6)
_MIN_NEIGHBOURS = 5
_MAX_ROUGHNESS = 0.5  # deviation from the plane over the smaller extent in it
_MIN_EXTENT = 0.15  # smaller extent in the plane over the voxel size: a line of points, as of one beam, has no normal


class AggregatedPoints(SlidingWindow):
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
        self.voxel_size_m = voxel_size_m
        super().__init__(device)
        self._table = torch.full((1 << sum(_TABLE_BITS),), -1, dtype=torch.int32, device=device)

    def insert(self, points_world: Float[Tensor, "n 3"], frames: int) -> None:
        """Add the points that fall into free voxels as one scan; keep the last `frames` scans."""
        self.forget(frames - 1)
        free = self.lookup(voxel_cells(points_world, self.voxel_size_m)) < 0
        points_world = points_world[free]
        points_world = points_world[grid_sample(points_world, self.voxel_size_m)]
        cells = voxel_cells(points_world, self.voxel_size_m)
        new = self._append(points_world.mT)
        self._cells[new] = cells
        self._table[_slots(cells)] = torch.arange(new.start, new.stop, dtype=torch.int32, device=self._device)
        self._update_moments(new)

    def lookup(self, cells: Int[Tensor, "*batch 3"]) -> Int[Tensor, "*batch"]:
        """Index into `points` of the point in each voxel, -1 where there is none."""
        index = self._table[_slots(cells)].long()
        alive = index >= self._start
        same = (self._cells[index.clamp(min=0)] == cells).all(dim=-1)
        return torch.where(alive & same, index - self._start, -1)

    def around(self, points_world: Float[Tensor, "m 3"], radius: int, inner: int = -1) -> Int[Tensor, "m c"]:
        """Candidates for the neighbours of each point: what stands in the voxels up to so many steps from its own.

        Args:
            points_world: points [m], in the map's frame.
            radius: how many steps along each axis.
            inner: voxels up to this number of steps away are left out.

        Returns:
            Indices into `points`. An empty voxel, or one whose slot another voxel took, gives a point from anywhere:
            distances tell them apart, which is cheaper than to compare voxels.
        """
        cells = voxel_cells(points_world, self.voxel_size_m)
        return self._candidates(cells, radius, inner).clamp(min=self._start) - self._start

    def _candidates(self, cells: Int[Tensor, "m 3"], radius: int, inner: int = -1) -> Int[Tensor, "m c"]:
        """What the table says of the voxels in a cube around each voxel, as `_cube` lists them."""
        cells, steps = cells.int(), torch.arange(-radius, radius + 1, dtype=torch.int32, device=self._device)
        x, y, z = (_axis_slots(cells[:, axis, None] + steps, axis) for axis in range(3))
        slots = (x[:, :, None, None] | y[:, None, :, None] | z[:, None, None, :]).flatten(1)
        if inner >= 0:
            slots = slots[:, _cube(radius, self._device).abs().amax(dim=1) > inner]
        return self._table.index_select(0, slots.flatten()).view_as(slots)

    def _update_moments(self, new: slice) -> None:
        """Let the new points and their neighbours count each other, and refit the planes that changed."""
        cells = self._cells[new]
        index = self._candidates(cells, 1)
        row, column = (index >= self._start).nonzero(as_tuple=True)
        index = index[row, column].long()
        offsets = self._cells[index] - cells[row]
        near = (offsets.abs().amax(dim=1) <= 1) & (offsets != 0).any(dim=1)  # a slot may be another voxel's
        row, index = row[near], index[near]
        x, y, z = self._coordinates[:, index] - self._coordinates[:, new][:, row]
        ones = torch.ones_like(x)
        squares = (x * x, x * y, x * z, y * y, y * z, z * z)
        self._moments[new] = 0
        self._moments[new].index_add_(0, row, torch.stack([ones, x, y, z, *squares], dim=1))
        old = index < new.start  # pairs of new points occur twice, once from each side
        mirrored = torch.stack([ones, -x, -y, -z, *squares], dim=1)
        self._moments.index_add_(0, index[old], mirrored[old])
        changed = torch.zeros(self._end - self._start, dtype=torch.bool, device=self._device)
        changed[index - self._start] = True
        changed[new.start - self._start :] = True
        self._fit(changed.nonzero()[:, 0] + self._start)

    def _fit(self, index: Int[Tensor, "m"]) -> None:
        moments = self._moments[index]
        n = moments[:, :1] + 1  # the point itself, at offset zero
        mx, my, mz = (moments[:, 1:4] / n).unbind(-1)
        outer = torch.stack([mx * mx, mx * my, mx * mz, my * my, my * mz, mz * mz], dim=1)
        plane = fit_planes(moments[:, 4:] / n - outer)
        smallest_extent = _MIN_EXTENT * self.voxel_size_m
        self._normals[index] = plane.normals * _is_plane(moments[:, 0], plane.variances, smallest_extent)[:, None]

    def _move_to_front(self, needed: int) -> None:
        super()._move_to_front(needed)
        self._table.fill_(-1)
        living = self._cells[: self._end]
        self._table[_slots(living)] = torch.arange(len(living), dtype=torch.int32, device=self._device)

    def _rows(self) -> tuple[Tensor, ...]:
        return *super()._rows(), self._cells, self._moments

    def _reserve(self, capacity: int) -> None:
        super()._reserve(capacity)
        self._cells = torch.empty(capacity, 3, dtype=torch.int64, device=self._device)
        self._moments = torch.empty(capacity, 10, device=self._device)


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


def _slots(cells: Int[Tensor, "*batch 3"]) -> Int[Tensor, "*batch"]:
    x, y, z = (_axis_slots(cells[..., axis], axis) for axis in range(3))
    return x | y | z


def _axis_slots(cells: Int[Tensor, "*batch"], axis: int) -> Int[Tensor, "*batch"]:
    """The part of a table index that comes from one coordinate."""
    return (cells & ((1 << _TABLE_BITS[axis]) - 1)) << sum(_TABLE_BITS[axis + 1 :])
