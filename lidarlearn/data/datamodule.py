"""The pairs of a data set's sequences as Lightning wants them."""

import os
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import torch
from lightning.pytorch import LightningDataModule
from torch import Tensor
from torch.utils.data import ConcatDataset, DataLoader

from lidarlearn.data import cache
from lidarlearn.data.augmentation import Augmentation
from lidarlearn.data.pairs import Pair, ScanPairs
from lidarlearn.data.sequence import DataSet, Sequence
from lidarlearn.errors import UserError
from lidarlearn.geometry.projection import SphericalProjection


class OdometryDataModule(LightningDataModule):
    """Training pairs shuffled over all training sequences; each validation sequence on its own, in order.

    Batches reach the device as 16-bit integers and are decoded there.

    Args:
        data: the data set.
        batch_size: pairs of a batch.
        num_workers: processes that load batches; 0 loads them in the training process.
        cache_root: folder of the vertex maps' caches.
        height: rows of the network's image [px]; None takes the data set's.
        width: its columns [px]; None takes the data set's.
        augmentation: what is done to training pairs by chance; None for nothing.
        preparation_workers: processes that project scans into the cache; None takes one per core.
    """

    def __init__(
        self,
        data: DataSet,
        batch_size: int = 8,
        num_workers: int = 2,
        cache_root: str = "datasets/cache",
        height: int | None = None,
        width: int | None = None,
        augmentation: Augmentation | None = None,
        preparation_workers: int | None = None,
    ) -> None:
        super().__init__()
        self.data = data
        self.batch_size = batch_size
        self.num_workers = num_workers
        self.cache_root = Path(cache_root).expanduser()
        self.augmentation = augmentation
        self.preparation_workers = _usable_cores() if preparation_workers is None else preparation_workers
        self.projection: SphericalProjection = replace(
            data.projection, height=height or data.projection.height, width=width or data.projection.width
        )
        self.val_sequences: list[Sequence] = []

    def prepare_data(self) -> None:
        """Make the data, where it is made on the spot, and the caches; Lightning calls it in one process only.

        Raises:
            DataSetNotFoundError: something that is needed is missing.
            DamagedFileError: a scan, or poses, cannot be read.
            UserError: a sequence lacks the ground truth that the module `needs_ground_truth` for.
        """
        self.data.prepare()
        # All are opened first: what is missing or unlabelled is told before minutes of projecting.
        sequences = self.data.sequences(dict.fromkeys([*self.data.train_sequences, *self.data.val_sequences]))
        if self.trainer is not None and getattr(self.trainer.lightning_module, "needs_ground_truth", False):
            _require_ground_truth(sequences)
        for sequence in sequences.values():
            self._vertex_maps(sequence)

    def setup(self, stage: str | None = None) -> None:
        """Open sequences and caches; called in every process."""
        train = [self.data.sequence(name) for name in self.data.train_sequences]
        # One sequence without ground truth and the batches of all go without: a batch holds the same for every pair.
        labelled = all(sequence.T_world_lidar is not None for sequence in train)
        pairs = [self._pairs(s, labelled, self.augmentation) for s in train]
        if not sum(map(len, pairs)):
            raise UserError(
                f"{self.data.title}: no pair of scans to train on in sequences {list(self.data.train_sequences)}"
                "\n  change: data.train_sequences, or data.max_frames"
            )
        self._train_pairs: ConcatDataset[Pair] = ConcatDataset(pairs)
        self.val_sequences = [self.data.sequence(name) for name in self.data.val_sequences]
        self._val_pairs = [self._pairs(s, s.T_world_lidar is not None) for s in self.val_sequences]

    def train_dataloader(self) -> DataLoader[Pair]:
        """Shuffled pairs of all training sequences; a last, smaller batch is left out."""
        return self._loader(self._train_pairs, shuffle=True, drop_last=len(self._train_pairs) > self.batch_size)

    def val_dataloader(self) -> list[DataLoader[Pair]]:
        """One loader per validation sequence, in the order of `val_sequences`."""
        return [self._loader(pairs) for pairs in self._val_pairs]

    def on_after_batch_transfer(self, batch: Any, dataloader_idx: int) -> Any:
        """Decode vertex maps to metres, on the device: half the traffic to it."""
        maps: dict[str, Tensor] = {key: cache.decode(batch[key]) for key in ("reference", "target")}
        return {**batch, **maps}

    def _pairs(self, sequence: Sequence, labelled: bool, augmentation: Augmentation | None = None) -> ScanPairs:
        step = None if augmentation is None else augmentation.step
        T_world_lidar = sequence.T_world_lidar if labelled else None
        return ScanPairs(self._vertex_maps(sequence), T_world_lidar, augmentation, step)

    def _vertex_maps(self, sequence: Sequence) -> cache.VertexMaps:
        return cache.cached_vertex_maps(sequence, self.projection, self.cache_root, self.preparation_workers)

    def _loader(
        self, pairs: ScanPairs | ConcatDataset[Pair], shuffle: bool = False, drop_last: bool = False
    ) -> DataLoader[Pair]:
        return DataLoader(
            pairs,
            batch_size=self.batch_size,
            shuffle=shuffle,
            drop_last=drop_last,
            num_workers=self.num_workers,
            # of training only until the epoch ends: new ones begin with the main process' random numbers, which a
            # resumed training takes up
            persistent_workers=self.num_workers > 0 and not shuffle,
            pin_memory=torch.cuda.is_available(),
        )


def _require_ground_truth(sequences: Mapping[str, Sequence]) -> None:
    without = [name for name, sequence in sequences.items() if sequence.T_world_lidar is None]
    if without:
        raise UserError(
            f"loss=supervised needs ground truth, and there is none of {', '.join(without)}.\n"
            "  change: data.train_sequences and data.val_sequences to those that have it, or loss=weighted_icp"
        )


def _usable_cores() -> int:
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
