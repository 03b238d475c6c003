"""The nearest two of a few candidates for each point."""

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor


@dataclass(frozen=True)
class NearestTwo:
    """The nearest candidate of each point, and the distances of the nearest two.

    Args:
        index: the nearest map point.
        first_m: its distance [m], infinite where there is no candidate.
        second_m: distance of the second nearest [m], infinite where there is none.
    """

    index: Int[Tensor, "n"]
    first_m: Float[Tensor, "n"]
    second_m: Float[Tensor, "n"]

    def improved(self, which: Int[Tensor, "m"], by: "NearestTwo") -> "NearestTwo":
        """A copy in which some points also have the candidates of another result."""
        first_m, index = self.first_m[which], torch.where(by.first_m < self.first_m[which], by.index, self.index[which])
        second_m = torch.maximum(first_m, by.first_m).minimum(self.second_m[which]).minimum(by.second_m)
        return NearestTwo(
            self.index.index_copy(0, which, index),
            self.first_m.index_copy(0, which, first_m.minimum(by.first_m)),
            self.second_m.index_copy(0, which, second_m),
        )


def joined(parts: Sequence[NearestTwo]) -> NearestTwo:
    """Concatenate results for several sets of points."""
    if len(parts) == 1:
        return parts[0]
    columns = zip(*((part.index, part.first_m, part.second_m) for part in parts), strict=True)
    return NearestTwo(*map(torch.cat, columns))


def nearest_two(
    coordinates: Float[Tensor, "3 m"],
    candidates: Int[Tensor, "n c"],
    points: Float[Tensor, "n 3"],
    usable: Bool[Tensor, "n c"] | None = None,
) -> NearestTwo:
    """Compare the candidates of each point.

    Args:
        coordinates: map points [m], each axis contiguous; may be a slice of a longer buffer.
        candidates: indices of map points.
        points: the points [m].
        usable: which candidates count; all of them if not given.
    """
    # Axis by axis: of a slice of three rows, `index_select` would first make a contiguous copy.
    flat = candidates.flatten()
    offsets = (
        axis.index_select(0, flat).view_as(candidates).sub_(own[:, None])
        for axis, own in zip(coordinates, points.mT, strict=True)
    )
    squared = next(offsets).square_()
    for offset in offsets:
        squared.addcmul_(offset, offset)
    if usable is not None:
        squared.masked_fill_(~usable, torch.inf)
    nearest = squared.argmin(dim=1, keepdim=True)
    first = squared.gather(1, nearest)[:, 0]
    second = squared.scatter_(1, nearest, torch.inf).amin(dim=1)
    return NearestTwo(candidates.gather(1, nearest)[:, 0].long(), first.sqrt_(), second.sqrt_())
