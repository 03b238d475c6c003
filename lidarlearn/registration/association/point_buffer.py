"""A growing buffer for the points of the last scans."""

import torch
from jaxtyping import Float, Int
from torch import Tensor

from lidarlearn import cuda_graphs
from lidarlearn.cuda_graphs import GraphCache

_INITIAL_CAPACITY = 1 << 16  # points
_INITIAL_CAPACITY_ON_GPU = 1 << 21  # enough for 30 scans: when buffers grow, all graphs are captured again


class PointBuffer:
    """Points and normals of the last scans in one growing buffer, oldest first.

    Adding a scan appends it, forgetting one advances the start; when the buffer is full, the remaining points move to
    its front. Each axis is contiguous in memory, as projections and distances are computed axis by axis.

    Attributes:
        slot_coordinates: coordinates [m] of all slots (3, capacity), including forgotten points and free slots.
        origin: slot of the first point, as a tensor on the device.
        graphs: CUDA graphs of functions that read this memory, cleared when it is replaced.

    Args:
        device: where the points are kept.
    """

    def __init__(self, device: torch.device) -> None:
        self._device = device
        self._start = self._end = 0
        self._lengths: list[int] = []
        self._forgotten = 0
        self.origin = torch.zeros((), dtype=torch.int32, device=device)
        self.graphs = GraphCache()
        self._reserve(_INITIAL_CAPACITY_ON_GPU if cuda_graphs.supported_on(device) else _INITIAL_CAPACITY)

    @property
    def points(self) -> Float[Tensor, "n 3"]:
        """All points [m]."""
        return self.coordinates.mT

    @property
    def coordinates(self) -> Float[Tensor, "3 n"]:
        """All points [m], each axis contiguous."""
        return self.slot_coordinates[:, self._start : self._end]

    @property
    def normals(self) -> Float[Tensor, "n 3"]:
        """Unit normals of the points, zero where undefined."""
        return self._normals[self._start : self._end]

    def points_at(self, index: Int[Tensor, "m"]) -> Float[Tensor, "m 3"]:
        """`points[index]`."""
        return self.slot_coordinates.index_select(1, index + self.origin).mT.contiguous()

    def normals_at(self, index: Int[Tensor, "m"]) -> Float[Tensor, "m 3"]:
        """`normals[index]`."""
        return self._normals.index_select(0, index + self.origin)

    @property
    def end(self) -> int:
        """The slot after the last point."""
        return self._end

    def __len__(self) -> int:
        """Number of scans."""
        return len(self._lengths)

    def append(self, coordinates: Float[Tensor, "3 m"], normals: Float[Tensor, "m 3"]) -> int:
        """Append a scan; returns by how many slots the other points moved towards the front."""
        new, moved = self._allocate(coordinates.shape[1])
        self.slot_coordinates[:, new] = coordinates
        self._normals[new] = normals
        self._scans[new] = self._forgotten + len(self) - 1
        return moved

    @property
    def scans(self) -> Int[Tensor, "n"]:
        """The scan of each point, 0 for the oldest."""
        return self._scans[self._start : self._end] - self.oldest_scan

    def at(self, slots: Int[Tensor, "m"]) -> tuple[Float[Tensor, "3 m"], Int[Tensor, "m"]]:
        """Coordinates of the points in some slots, and the number of the scan of each."""
        return self.slot_coordinates[:, slots], self._scans[slots]

    @property
    def oldest_scan(self) -> int:
        """Number of the oldest scan in the buffer; the first scan ever added is number 0."""
        return self._forgotten

    def forget(self, scans: int) -> None:
        """Keep at most the last `scans` scans."""
        while len(self._lengths) > scans:
            self._start += self._lengths.pop(0)
            self._forgotten += 1
        self.origin.fill_(self._start)

    @property
    def _capacity(self) -> int:
        return len(self._normals)

    def _allocate(self, count: int, spare: int = 0) -> tuple[slice, int]:
        """The slots for a new scan, and by how many slots the other points moved to make room.

        Args:
            count: number of its points.
            spare: number of free slots to leave behind them.
        """
        moved = 0
        if self._end + count + spare > self._capacity:
            moved = self._start
            self._move_to_front(count + spare)
        new = slice(self._end, self._end + count)
        self._lengths.append(count)
        self._end = new.stop
        return new, moved

    def _move_to_front(self, needed: int) -> None:
        """Move all points to the front; the buffers grow if they would otherwise soon be full again."""
        count = self._end - self._start
        living = [rows[self._start : self._end].clone() for rows in self._buffers()]
        if 2 * (count + needed) > self._capacity:
            self._reserve(2 * (count + needed))
        for rows, content in zip(self._buffers(), living, strict=True):
            rows[:count] = content
        self._start, self._end = 0, count
        self.origin.zero_()

    def _buffers(self) -> tuple[Tensor, ...]:
        """All buffers, one row per slot."""
        return self.slot_coordinates.mT, self._normals, self._scans

    def _reserve(self, capacity: int) -> None:
        self.slot_coordinates = torch.empty(3, capacity, device=self._device)
        self._normals = torch.empty(capacity, 3, device=self._device)
        self._scans = torch.empty(capacity, dtype=torch.int32, device=self._device)
        self.graphs.clear()
