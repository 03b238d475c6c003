"""Pairs of consecutive scans, what a network that regresses relative poses trains on."""

from typing import TypedDict

import torch
from jaxtyping import Float, Shaped
from torch import Tensor
from torch.utils.data import Dataset
from typing_extensions import NotRequired

from lidarlearn.data.cache import VertexMaps
from lidarlearn.geometry import se3


class Pair(TypedDict):
    """Two consecutive scans, or a batch of such.

    Keys:
        reference: vertex map of the earlier scan, as cached: multiples of `cache.QUANTUM_M`, zeros where no point fell.
        target: vertex map of the new scan, likewise.
        index: the reference's place in its sequence.
        T_ref_new: true relative pose, float64; only with ground truth.
    """

    reference: Shaped[Tensor, "*batch 3 h w"]
    target: Shaped[Tensor, "*batch 3 h w"]
    index: int | Tensor
    T_ref_new: NotRequired[Float[Tensor, "*batch 4 4"]]


class ScanPairs(Dataset[Pair]):
    """The pairs (i, i + 1) of one sequence, in order.

    Args:
        vertex_maps: of all its scans.
        T_world_lidar: ground-truth poses of all its scans; None to go without.
        mirror: show every other pair, by chance, mirrored left to right. A mirrored drive is as plausible as the
            original, and a left turn becomes a right one.

    Raises:
        ValueError: the numbers of scans and poses differ, or a pose is not finite.
    """

    def __init__(
        self, vertex_maps: VertexMaps, T_world_lidar: Float[Tensor, "n 4 4"] | None, mirror: bool = False
    ) -> None:
        if T_world_lidar is not None and (len(T_world_lidar) != len(vertex_maps) or not T_world_lidar.isfinite().all()):
            raise ValueError(
                f"{len(vertex_maps)} scans need as many finite ground-truth poses, got {len(T_world_lidar)}"
            )
        self.vertex_maps = vertex_maps
        self.T_ref_new = None if T_world_lidar is None else se3.relative(T_world_lidar)
        self.mirror = mirror

    def __len__(self) -> int:
        return max(len(self.vertex_maps) - 1, 0)

    def __getitem__(self, index: int) -> Pair:
        pair = Pair(reference=self.vertex_maps[index], target=self.vertex_maps[index + 1], index=index)
        if self.T_ref_new is not None:
            pair["T_ref_new"] = self.T_ref_new[index]
        return mirrored(pair) if self.mirror and torch.rand(()) < 0.5 else pair


def mirrored(pair: Pair) -> Pair:
    """The pair as its mirror image at the plane y = 0, left and right exchanged.

    Azimuth a becomes -a, and with it column c becomes width - 1 - c.
    """
    flip = torch.tensor([1, -1, 1])[:, None, None]
    image = Pair(
        reference=(pair["reference"] * flip.to(pair["reference"].dtype)).flip(-1),
        target=(pair["target"] * flip.to(pair["target"].dtype)).flip(-1),
        index=pair["index"],
    )
    if "T_ref_new" in pair:
        M = torch.diag(torch.tensor([1.0, -1.0, 1.0, 1.0], dtype=pair["T_ref_new"].dtype))
        image["T_ref_new"] = M @ pair["T_ref_new"] @ M
    return image
