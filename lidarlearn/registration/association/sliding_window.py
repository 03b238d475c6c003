"""The points of the last scans in one piece of memory."""

import torch
from jaxtyping import Float, Int
from torch import Tensor


class SlidingWindow:
    """Points and normals of the last scans, oldest first: a new scan is written behind the others, none is moved.

    Coordinates lie apart in memory: projections and distances are computed axis by axis. Forgetting moves the start of
    a slice; only when the end of the buffers is reached, once in many scans, what is left moves to their front.

    Args:
        device: where the points are kept.
    """

    def __init__(self, device: torch.device) -> None:
        self._device = device
        self._start = self._end = 0
        self._lengths: list[int] = []
        self._forgotten = 0
        self._reserve(1 << 16)

    @property
    def points(self) -> Float[Tensor, "n 3"]:
        """All points [m]."""
        return self.coordinates.mT

    @property
    def coordinates(self) -> Float[Tensor, "3 n"]:
        """The same, each coordinate of all points in one piece."""
        return self._coordinates[:, self._start : self._end]

    @property
    def normals(self) -> Float[Tensor, "n 3"]:
        """Their unit normals, zero where undefined."""
        return self._normals[self._start : self._end]

    def __len__(self) -> int:
        """Number of scans."""
        return len(self._lengths)

    def push(self, coordinates: Float[Tensor, "3 m"], normals: Float[Tensor, "m 3"]) -> None:
        """Add a scan."""
        new = self._append(coordinates)
        self._normals[new] = normals

    def last(self, scans: int) -> tuple[Float[Tensor, "3 m"], Int[Tensor, "m"]]:
        """Coordinates of the points of the last scans, and which scan each comes from, 0 for the oldest of these."""
        points = slice(self._end - sum(self._lengths[-scans:]), self._end)
        first = self._forgotten + len(self._lengths) - scans
        return self._coordinates[:, points], self._scans[points] - first

    def forget(self, scans: int) -> int:
        """Keep the last `scans` scans at most; returns how many points are forgotten."""
        start = self._start
        while len(self._lengths) > scans:
            self._start += self._lengths.pop(0)
            self._forgotten += 1
        return self._start - start

    def _append(self, coordinates: Float[Tensor, "3 m"]) -> slice:
        """Where the points of a new scan stand in the buffers."""
        count = coordinates.shape[1]
        if self._end + count > len(self._normals):
            self._move_to_front(count)
        new = slice(self._end, self._end + count)
        self._coordinates[:, new] = coordinates
        self._scans[new] = self._forgotten + len(self._lengths)
        self._lengths.append(count)
        self._end = new.stop
        return new

    def _move_to_front(self, needed: int) -> None:
        """Into buffers that hold at least twice as many."""
        living = [rows[self._start : self._end] for rows in self._rows()]
        count = self._end - self._start
        self._reserve(max(2 * (count + needed), len(self._normals)))
        for rows, content in zip(self._rows(), living, strict=True):
            rows[:count] = content
        self._start, self._end = 0, count

    def _rows(self) -> tuple[Tensor, ...]:
        """The buffers, one row a point."""
        return self._coordinates.mT, self._normals, self._scans

    def _reserve(self, capacity: int) -> None:
        self._coordinates = torch.empty(3, capacity, device=self._device)
        self._normals = torch.empty(capacity, 3, device=self._device)
        self._scans = torch.empty(capacity, dtype=torch.int32, device=self._device)
