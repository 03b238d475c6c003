"""Pairs of consecutive scans, on which a network that regresses relative poses is trained."""

from collections.abc import Sequence
from typing import TypedDict

import torch
from jaxtyping import Float, Int, Shaped
from torch import Tensor
from torch.utils.data import Dataset
from typing_extensions import NotRequired

from lidarlearn.data.cache import VertexMaps
from lidarlearn.geometry import se3


class Pair(TypedDict):
    """Two consecutive scans, or a batch of such pairs.

    Keys:
        reference: vertex map of the earlier scan [m], zeros where no point fell; in the pairs of `ScanPairs`, its row
            among all vertex maps, see `with_maps`.
        target: vertex map of the new scan, likewise.
        index: of the reference in its sequence.
        T_ref_new: true relative pose, float64; only with ground truth.
    """

    reference: Shaped[Tensor, "*map"]
    target: Shaped[Tensor, "*map"]
    index: Int[Tensor, "*batch"]
    T_ref_new: NotRequired[Float[Tensor, "*batch 4 4"]]


class ScanPairs(Dataset[Pair]):
    """The pairs (i, i + 1) of sequences, in order; yields whole batches, with row numbers in place of vertex maps.

    Args:
        rows: rows of each sequence among all vertex maps.
        T_world_lidar: ground-truth poses of each sequence; None for none.
        max_skip: the second scan of a pair is a random number of scans, up to this one, after the first, but never
            beyond the end of the sequence.

    Raises:
        ValueError: the numbers of scans and poses differ, or a pose is not finite.
    """

    def __init__(
        self,
        rows: Sequence[range],
        T_world_lidar: Sequence[Float[Tensor, "_ 4 4"]] | None,
        max_skip: int = 1,
    ) -> None:
        self.max_skip = max_skip
        none = torch.zeros(0, dtype=torch.long)
        self._references = torch.cat([none, *(torch.tensor(r[:-1], dtype=torch.long) for r in rows)])
        self._firsts = torch.cat([none, *(torch.full((len(r[:-1]),), r.start) for r in rows)])
        self._lasts = torch.cat([none, *(torch.full((len(r[:-1]),), r.stop - 1) for r in rows)])
        self._T_world_lidar = None if T_world_lidar is None else _by_row(rows, T_world_lidar)

    def __len__(self) -> int:
        return len(self._references)

    def __getitems__(self, indices: list[int]) -> Pair:
        """A batch of pairs; called by torch's loaders."""
        chosen = torch.tensor(indices)
        reference = self._references[chosen]
        step = 1 if self.max_skip == 1 else torch.randint(1, self.max_skip + 1, reference.shape)
        target = torch.minimum(reference + step, self._lasts[chosen])
        batch = Pair(reference=reference, target=target, index=reference - self._firsts[chosen])
        if self._T_world_lidar is not None:
            batch["T_ref_new"] = se3.inverse(self._T_world_lidar[reference]) @ self._T_world_lidar[target]
        return batch


def with_maps(batch: Pair, maps: VertexMaps | Shaped[Tensor, "n 3 h w"]) -> Pair:
    """The batch with encoded vertex maps in place of their rows, from files or from the memory of its device."""
    return {**batch, "reference": maps[batch["reference"]], "target": maps[batch["target"]]}


def _by_row(rows: Sequence[range], T_world_lidar: Sequence[Float[Tensor, "_ 4 4"]]) -> Float[Tensor, "m 4 4"]:
    """The pose of each row; NaN for rows of other sequences."""
    by_row = torch.full((max((r.stop for r in rows), default=0), 4, 4), torch.nan, dtype=torch.float64)
    for scans, poses in zip(rows, T_world_lidar, strict=True):
        finite = int(poses.isfinite().all(-1).all(-1).sum())
        if not len(poses) == len(scans) == finite:
            raise ValueError(
                f"{len(scans)} scans need as many finite ground-truth poses, got {len(poses)}, {finite} of them finite"
            )
        by_row[scans.start : scans.stop] = poses
    return by_row
