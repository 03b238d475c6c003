"""Pairs that might as well have been recorded: each change of the scans changes the label along."""

import math
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Shaped
from torch import Tensor

from lidarlearn.data.cache import to_16_bits
from lidarlearn.data.pairs import Pair
from lidarlearn.geometry import se3


@dataclass(frozen=True)
class Augmentation:
    """What happens to training pairs by chance; nothing of it to validation.

    Args:
        mirror: half of the pairs are mirrored left to right: a left turn becomes a right one.
        turn: the sensor is turned about its vertical axis by any angle: the columns of both images roll, and a car
            that drives forward drives sideways. For platforms that move in any direction.
        reverse: half of the pairs swap their scans: a car that drives forward drives backward.
        max_skip: the second scan of a pair is up to so many scans after the first; 1 for neighbours alone. Steps of
            two or three show a network trained in town the speeds of a motorway.
        drop_out: up to this share of the pixels of each image is emptied.
    """

    mirror: bool = False
    turn: bool = False
    reverse: bool = False
    max_skip: int = 1
    drop_out: float = 0.0

    def __post_init__(self) -> None:
        if self.max_skip < 1 or not 0 <= self.drop_out < 1:
            raise ValueError(f"an augmentation needs max_skip >= 1 and 0 <= drop_out < 1, got {self}")

    def step(self) -> int:
        """How many scans lie between the two of a pair, from 1 to `max_skip`."""
        return 1 if self.max_skip == 1 else int(torch.randint(1, self.max_skip + 1, ()))

    def __call__(self, pair: Pair) -> Pair:
        """The pair, changed by chance."""
        if self.mirror and torch.rand(()) < 0.5:
            pair = mirrored(pair)
        if self.reverse and torch.rand(()) < 0.5:
            pair = reversed_in_time(pair)
        if self.turn:
            pair = turned(pair, columns=int(torch.randint(pair["reference"].shape[-1], ())))
        if self.drop_out > 0:
            keep = [torch.rand(pair["reference"].shape[1:]) >= self.drop_out * torch.rand(()) for _ in range(2)]
            pair = thinned(pair, *keep)
        return pair


def mirrored(pair: Pair) -> Pair:
    """The pair as its mirror image at the plane y = 0, left and right exchanged.

    Azimuth a becomes -a, and with it column c becomes width - 1 - c.
    """
    flip = torch.tensor([1, -1, 1])[:, None, None]

    def mirror(vertex_map: Shaped[Tensor, "3 h w"]) -> Shaped[Tensor, "3 h w"]:
        return (vertex_map * flip.to(vertex_map.dtype)).flip(-1)

    M = torch.diag(torch.tensor([1.0, -1.0, 1.0, 1.0], dtype=torch.float64))
    return _seen_by(pair, mirror(pair["reference"]), mirror(pair["target"]), M)


def turned(pair: Pair, columns: int) -> Pair:
    """The pair as a sensor sees it that is turned, counter-clockwise, by the angle of so many columns.

    Points that 16 bits cannot hold any more, beyond 131 m along an axis, become empty pixels.
    """
    angle = 2 * math.pi * columns / pair["reference"].shape[-1]
    M = se3.from_euler(torch.tensor([0, 0, 0, 0, 0, -angle], dtype=torch.float64))

    def turn(vertex_map: Shaped[Tensor, "3 h w"]) -> Shaped[Tensor, "3 h w"]:
        points = torch.einsum("ij,jhw->ihw", M[:3, :3].float(), vertex_map.float()).roll(columns, dims=-1)
        return points if vertex_map.is_floating_point() else to_16_bits(points)

    return _seen_by(pair, turn(pair["reference"]), turn(pair["target"]), M)


def reversed_in_time(pair: Pair) -> Pair:
    """The later scan first; `index` stays that of the earlier one."""
    swapped = Pair(reference=pair["target"], target=pair["reference"], index=pair["index"])
    if "T_ref_new" in pair:
        swapped["T_ref_new"] = se3.inverse(pair["T_ref_new"])
    return swapped


def thinned(pair: Pair, keep_reference: Bool[Tensor, "h w"], keep_target: Bool[Tensor, "h w"]) -> Pair:
    """The pair with all other pixels emptied."""
    return {**pair, "reference": pair["reference"] * keep_reference, "target": pair["target"] * keep_target}


def _seen_by(
    pair: Pair,
    reference: Shaped[Tensor, "3 h w"],
    target: Shaped[Tensor, "3 h w"],
    M: Float[Tensor, "4 4"],
) -> Pair:
    """Other images of the pair's scans: points p have become M p."""
    image = Pair(reference=reference, target=target, index=pair["index"])
    if "T_ref_new" in pair:
        image["T_ref_new"] = M @ pair["T_ref_new"] @ torch.linalg.inv(M)
    return image
