"""The points of the last scans in one piece of memory."""

import torch
from jaxtyping import Float, Int
from torch import Tensor


class SlidingWindow:
    """Points and normals of the last scans, oldest first: a new scan is written behind the others, none is moved.

    Coordinates lie apart in memory, as projections and distances like them. Only when the end of the buffers is
    reached, once in many scans, what is left moves to their front.

    Args:
        device: where the points are kept.
    """

    def __init__(self, device: torch.device) -> None:
        self._device = device
        self._start = self._end = 0
        self._lengths: list[int] = []
        self._dropped = 0
        self._reserve(1 << 16)

    @property
    def coordinates(self) -> Float[Tensor, "3 n"]:
        """All points [m]."""
        return self._coordinates[:, self._start : self._end]

    @property
    def normals(self) -> Float[Tensor, "n 3"]:
        """Their unit normals."""
        return self._normals[self._start : self._end]

    @property
    def scans(self) -> Int[Tensor, "n"]:
        """Which scan each comes from, 0 for the oldest."""
        return self._scans[self._start : self._end] - self._dropped

    def __len__(self) -> int:
        """Number of scans."""
        return len(self._lengths)

    def push(self, coordinates: Float[Tensor, "3 m"], normals: Float[Tensor, "m 3"], scans: int) -> None:
        """Add a scan and forget all but the last `scans` scans, this one included."""
        while len(self._lengths) >= scans:
            self._start += self._lengths.pop(0)
            self._dropped += 1
        if self._end + len(normals) > len(self._normals):
            self._move_to_front(len(normals))
        new = slice(self._end, self._end + len(normals))
        self._coordinates[:, new] = coordinates
        self._normals[new] = normals
        self._scans[new] = self._dropped + len(self._lengths)
        self._lengths.append(len(normals))
        self._end = new.stop

    def _move_to_front(self, needed: int) -> None:
        """Into buffers that hold at least twice as many."""
        living = slice(self._start, self._end)
        coordinates, normals, scans = self._coordinates[:, living], self._normals[living], self._scans[living]
        count = len(normals)
        self._reserve(max(2 * (count + needed), len(self._normals)))
        self._coordinates[:, :count], self._normals[:count], self._scans[:count] = coordinates, normals, scans
        self._start, self._end = 0, count

    def _reserve(self, capacity: int) -> None:
        self._coordinates = torch.empty(3, capacity, device=self._device)
        self._normals = torch.empty(capacity, 3, device=self._device)
        self._scans = torch.empty(capacity, dtype=torch.int32, device=self._device)
