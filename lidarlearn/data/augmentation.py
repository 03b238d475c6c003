"""Augmentation of training pairs: every change of the scans also changes the true relative pose."""

import math
from dataclasses import dataclass
from typing import Literal

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from lidarlearn.data.pairs import Pair
from lidarlearn.geometry import se3


@dataclass(frozen=True)
class Augmentation:
    """Random changes of training pairs; validation pairs stay as they are.

    Args:
        mirror: mirror half of the pairs left to right: a left turn becomes a right turn.
        turn: turn the sensor about its vertical axis by a random angle: the columns of both images roll, and a car
            that drives forward drives sideways. For platforms that move in any direction.
        reverse: swap the scans of half of the pairs: a car that drives forward drives backward.
        max_skip: most scans from the first to the second scan of a pair; 1 for neighbours only. Steps of two or three
            show a network trained in town the speeds of a motorway. See `ScanPairs`.
        drop_out: largest share of the pixels of each image that are emptied.
    """

    mirror: bool = False
    turn: bool = False
    reverse: bool = False
    max_skip: int = 1
    drop_out: float = 0.0

    def __post_init__(self) -> None:
        if self.max_skip < 1 or not 0 <= self.drop_out < 1:
            raise ValueError(f"an augmentation needs max_skip >= 1 and 0 <= drop_out < 1, got {self}")

    def __call__(self, batch: Pair) -> Pair:
        """The batch with each pair changed independently, on the device where it is.

        All randomness comes from the CPU's generator, whose state is kept in checkpoints.
        """
        (pairs, _, height, width), device = batch["reference"].shape, batch["reference"].device
        if self.mirror:
            batch = _where(_half_of(pairs, device), mirrored(batch), batch)
        if self.reverse:
            batch = _where(_half_of(pairs, device), reversed_in_time(batch), batch)
        if self.turn:
            batch = turned(batch, torch.randint(width, (pairs,)).to(device, non_blocking=True))
        if self.drop_out > 0:
            generator = torch.Generator(device).manual_seed(int(torch.randint(2**62, ())))
            chances = torch.rand(2, pairs, height, width, generator=generator, device=device)
            shares = self.drop_out * torch.rand(2, pairs, 1, 1, generator=generator, device=device)
            batch = thinned(batch, *(chances >= shares))
        return batch


def mirrored(pair: Pair) -> Pair:
    """The pair mirrored at the plane y = 0: left and right are exchanged.

    Azimuth a becomes -a, so column c becomes width - 1 - c.
    """
    flip = torch.eye(4, dtype=torch.float64, device=pair["reference"].device)
    flip[1, 1] = -1

    def mirror(vertex_map: Float[Tensor, "*batch 3 h w"]) -> Float[Tensor, "*batch 3 h w"]:
        image = vertex_map.flip(-1)
        image[..., 1, :, :].neg_()
        return image

    return _seen_by(pair, mirror(pair["reference"]), mirror(pair["target"]), flip)


def turned(pair: Pair, columns: Int[Tensor, "*batch"]) -> Pair:
    """The pair as seen by a sensor that is turned counter-clockwise by the angle of the given number of columns."""
    width = pair["reference"].shape[-1]
    angles = columns.double() * (-2 * math.pi / width)
    M = se3.from_euler(torch.nn.functional.pad(angles[..., None], (5, 0)))
    before = (torch.arange(width, device=columns.device) - columns[..., None]) % width

    def turn(vertex_map: Float[Tensor, "*batch 3 h w"]) -> Float[Tensor, "*batch 3 h w"]:
        points = torch.einsum("...ij,...jhw->...ihw", M[..., :3, :3].to(vertex_map), vertex_map)
        return points.gather(-1, before[..., None, None, :].expand(points.shape))

    return _seen_by(pair, turn(pair["reference"]), turn(pair["target"]), M)


def reversed_in_time(pair: Pair) -> Pair:
    """The pair with the later scan first; `index` remains that of the earlier one."""
    swapped = Pair(reference=pair["target"], target=pair["reference"], index=pair["index"])
    if "T_ref_new" in pair:
        swapped["T_ref_new"] = se3.inverse(pair["T_ref_new"])
    return swapped


def thinned(pair: Pair, keep_reference: Bool[Tensor, "*batch h w"], keep_target: Bool[Tensor, "*batch h w"]) -> Pair:
    """The pair with all pixels emptied that are not to be kept."""
    reference, target = keep_reference.unsqueeze(-3), keep_target.unsqueeze(-3)
    return {**pair, "reference": pair["reference"] * reference, "target": pair["target"] * target}


def _seen_by(
    pair: Pair,
    reference: Float[Tensor, "*batch 3 h w"],
    target: Float[Tensor, "*batch 3 h w"],
    M: Float[Tensor, "*#batch 4 4"],
) -> Pair:
    """The pair with new vertex maps, in which each point p has become M p, with an orthogonal M."""
    image = Pair(reference=reference, target=target, index=pair["index"])
    if "T_ref_new" in pair:
        M = M.to(pair["T_ref_new"])
        image["T_ref_new"] = M @ pair["T_ref_new"] @ se3.inverse(M)
    return image


def _half_of(pairs: int, device: torch.device) -> Bool[Tensor, "batch"]:
    return (torch.rand(pairs) < 0.5).to(device, non_blocking=True)


def _where(chosen: Bool[Tensor, "batch"], changed: Pair, batch: Pair) -> Pair:
    """The chosen pairs from `changed`, the others from `batch`."""

    def choose(key: Literal["reference", "target", "T_ref_new"]) -> Tensor:
        return torch.where(chosen.reshape(-1, *[1] * (batch[key].dim() - 1)), changed[key], batch[key])

    pairs: Pair = {**batch, "reference": choose("reference"), "target": choose("target")}
    if "T_ref_new" in batch:
        pairs["T_ref_new"] = choose("T_ref_new")
    return pairs
