"""The points of the last scans in one piece of memory."""

import torch
from jaxtyping import Float, Int
from torch import Tensor

from lidarlearn import cuda_graphs

_INITIAL_CAPACITY = 1 << 16  # points
_INITIAL_CAPACITY_ON_GPU = (
    1 << 21
)  # as many as 30 scans need: where buffers move, all that was recorded is recorded again


class PointBuffer:
    """Points and normals of the last scans, oldest first: a new scan is written behind the others, none is moved.

    Coordinates lie apart in memory: projections and distances are computed axis by axis. Forgetting moves the start of
    a slice; only when the end of the buffers is reached, once in many scans, what is left moves to their front.

    Attributes:
        slot_coordinates: coordinates (3, capacity) by slot, those of forgotten points and of free slots included.
        origin: the slot of the first point, a number on the device.
        recordings: of functions that read the buffers where they are.

    Args:
        device: where the points are kept.
    """

    def __init__(self, device: torch.device) -> None:
        self._device = device
        self._start = self._end = 0
        self._lengths: list[int] = []
        self._forgotten = 0
        self.origin = torch.zeros((), dtype=torch.int32, device=device)
        self.recordings = cuda_graphs.Recordings()
        self._reserve(_INITIAL_CAPACITY_ON_GPU if cuda_graphs.are_used_on(device) else _INITIAL_CAPACITY)

    @property
    def points(self) -> Float[Tensor, "n 3"]:
        """All points [m]."""
        return self.coordinates.mT

    @property
    def coordinates(self) -> Float[Tensor, "3 n"]:
        """The same, each coordinate of all points in one piece."""
        return self.slot_coordinates[:, self._start : self._end]

    @property
    def normals(self) -> Float[Tensor, "n 3"]:
        """Their unit normals, zero where undefined."""
        return self._normals[self._start : self._end]

    def points_at(self, index: Int[Tensor, "m"]) -> Float[Tensor, "m 3"]:
        """Some of `points`, by their index."""
        return self.slot_coordinates.index_select(1, index + self.origin).mT.contiguous()

    def normals_at(self, index: Int[Tensor, "m"]) -> Float[Tensor, "m 3"]:
        """Some of `normals`, by their index."""
        return self._normals.index_select(0, index + self.origin)

    @property
    def end(self) -> int:
        """The slot behind the last point."""
        return self._end

    def __len__(self) -> int:
        """Number of scans."""
        return len(self._lengths)

    def push(self, coordinates: Float[Tensor, "3 m"], normals: Float[Tensor, "m 3"]) -> int:
        """Add a scan; returns by how much all others have moved to the front of the buffers."""
        new, moved = self._allocate(coordinates.shape[1])
        self.slot_coordinates[:, new] = coordinates
        self._normals[new] = normals
        self._scans[new] = self._forgotten + len(self) - 1
        return moved

    @property
    def scans(self) -> Int[Tensor, "n"]:
        """Which scan each point comes from, 0 for the oldest."""
        return self._scans[self._start : self._end] - self.oldest_scan

    def at(self, slots: Int[Tensor, "m"]) -> tuple[Float[Tensor, "3 m"], Int[Tensor, "m"]]:
        """Coordinates of the points in some slots, and the number of the scan each comes from."""
        return self.slot_coordinates[:, slots], self._scans[slots]

    @property
    def oldest_scan(self) -> int:
        """Number of the oldest scan that is left, counted from the first there was."""
        return self._forgotten

    def forget(self, scans: int) -> int:
        """Keep the last `scans` scans at most; returns how many points are forgotten."""
        start = self._start
        while len(self._lengths) > scans:
            self._start += self._lengths.pop(0)
            self._forgotten += 1
        self.origin.fill_(self._start)
        return self._start - start

    @property
    def _capacity(self) -> int:
        return len(self._normals)

    def _allocate(self, count: int, spare: int = 0) -> tuple[slice, int]:
        """Where the points of a new scan will stand in the buffers, and by how much the others have moved to the front.

        Args:
            count: how many they are.
            spare: how many more slots behind them may be written to.
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
        """Of these buffers or, where they would soon be full again, of larger ones."""
        count = self._end - self._start
        living = [rows[self._start : self._end].clone() for rows in self._buffers()]
        if 2 * (count + needed) > self._capacity:
            self._reserve(2 * (count + needed))
        for rows, content in zip(self._buffers(), living, strict=True):
            rows[:count] = content
        self._start, self._end = 0, count
        self.origin.zero_()

    def _buffers(self) -> tuple[Tensor, ...]:
        """The buffers, one row a point."""
        return self.slot_coordinates.mT, self._normals, self._scans

    def _reserve(self, capacity: int) -> None:
        self.slot_coordinates = torch.empty(3, capacity, device=self._device)
        self._normals = torch.empty(capacity, 3, device=self._device)
        self._scans = torch.empty(capacity, dtype=torch.int32, device=self._device)
        self.recordings.forget()
