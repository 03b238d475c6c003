"""Pairs of neighbouring scans, what a network that regresses relative poses trains on."""

from collections.abc import Callable
from typing import TypedDict

from jaxtyping import Float, Shaped
from torch import Tensor
from torch.utils.data import Dataset
from typing_extensions import NotRequired

from lidarlearn.data.cache import VertexMaps
from lidarlearn.geometry import se3


class Pair(TypedDict):
    """Two neighbouring scans, or a batch of such.

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
        augment: what is done to each pair.
        step: asked for each pair, how many scans its second one is after its first; near the end of the sequence it
            is as many as there are.

    Raises:
        ValueError: the numbers of scans and poses differ, or a pose is not finite.
    """

    def __init__(
        self,
        vertex_maps: VertexMaps,
        T_world_lidar: Float[Tensor, "n 4 4"] | None,
        augment: Callable[[Pair], Pair] | None = None,
        step: Callable[[], int] | None = None,
    ) -> None:
        if T_world_lidar is not None and (len(T_world_lidar) != len(vertex_maps) or not T_world_lidar.isfinite().all()):
            raise ValueError(
                f"{len(vertex_maps)} scans need as many finite ground-truth poses, got {len(T_world_lidar)}"
            )
        self.vertex_maps, self.T_world_lidar = vertex_maps, T_world_lidar
        self.augment, self.step = augment, step

    def __len__(self) -> int:
        return max(len(self.vertex_maps) - 1, 0)

    def __getitem__(self, index: int) -> Pair:
        second = index + 1 if self.step is None else min(index + self.step(), len(self))
        pair = Pair(reference=self.vertex_maps[index], target=self.vertex_maps[second], index=index)
        if self.T_world_lidar is not None:
            pair["T_ref_new"] = se3.inverse(self.T_world_lidar[index]) @ self.T_world_lidar[second]
        return pair if self.augment is None else self.augment(pair)
