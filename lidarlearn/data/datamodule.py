"""The Lightning datamodule: pairs of scans from the sequences of a data set."""

import math
import os
from collections.abc import Collection, Mapping
from dataclasses import replace
from functools import partial
from itertools import accumulate
from pathlib import Path

import torch
from jaxtyping import Int16
from lightning.pytorch import LightningDataModule
from torch import Tensor
from torch.utils.data import DataLoader, default_convert

from lidarlearn.data import cache
from lidarlearn.data.augmentation import Augmentation
from lidarlearn.data.pairs import Pair, ScanPairs, with_maps
from lidarlearn.data.sequence import DataSet, Sequence
from lidarlearn.errors import UserError
from lidarlearn.geometry.projection import SphericalProjection

_RESIDENT_SHARE = 0.5  # of the free memory: the network and its batches need the rest


class OdometryDataModule(LightningDataModule):
    """Training pairs shuffled over all training sequences; each validation sequence on its own, in order.

    Batches reach the device as 16-bit integers, or as row numbers of vertex maps that are kept there. They are decoded
    and augmented on the device.

    Args:
        data: the data set.
        batch_size: pairs per batch.
        num_workers: processes that load batches; 0 loads them in the training process.
        cache_root: folder of the cached vertex maps.
        height: rows of the network's image [px]; None takes those of the data set.
        width: columns of the network's image [px]; None takes those of the data set.
        resident: whether to keep all vertex maps, 6 bytes a pixel, in the memory of the device; "auto" does so on a GPU
            if they take less than half of its free memory.
        augmentation: random changes of training pairs; None for none.
        preparation_workers: processes that project scans into the cache; None for one per core.
    """

    def __init__(
        self,
        data: DataSet,
        batch_size: int = 8,
        num_workers: int = 2,
        cache_root: str = "datasets/cache",
        height: int | None = None,
        width: int | None = None,
        resident: bool | str = "auto",
        augmentation: Augmentation | None = None,
        preparation_workers: int | None = None,
    ) -> None:
        super().__init__()
        if resident not in (True, False, "auto"):
            raise ValueError(f"resident is true, false or auto, got {resident!r}")
        self.data = data
        self._names = dict.fromkeys((*data.train_sequences, *data.val_sequences))  # each once, in order
        self.batch_size = batch_size
        self.num_workers = num_workers
        self.cache_root = Path(cache_root).expanduser()
        self.resident = resident
        self.augmentation = augmentation
        self.preparation_workers = _usable_cores() if preparation_workers is None else preparation_workers
        self.projection: SphericalProjection = replace(
            data.projection, height=height or data.projection.height, width=width or data.projection.width
        )
        self.val_sequences: list[Sequence] = []
        self._resident_maps: Int16[Tensor, "n 3 h w"] | None = None

    def prepare_data(self) -> None:
        """Simulate scans if the data set is a simulated one, and fill the caches; Lightning calls it in one process.

        Raises:
            DataSetNotFoundError: a sequence is missing.
            DamagedFileError: a scan or poses cannot be read.
            UserError: a sequence has no ground truth but the module `needs_ground_truth`, or the disk is too small.
        """
        self.data.prepare()
        # All are opened first: errors show before minutes of projecting.
        sequences = self.data.sequences(self._names)
        if self.trainer is not None and getattr(self.trainer.lightning_module, "needs_ground_truth", False):
            _require_ground_truth(sequences)
        cache.require_room(sequences.values(), self.projection, self.cache_root)
        for sequence in sequences.values():
            self._vertex_maps(sequence)

    def setup(self, stage: str | None = None) -> None:
        """Open the sequences and their caches; called in every process."""
        sequences = {name: self.data.sequence(name) for name in self._names}
        self._maps = cache.VertexMaps(*(file for s in sequences.values() for file in self._vertex_maps(s).files))
        ends = accumulate(map(len, sequences.values()))
        rows = {name: range(end - len(sequences[name]), end) for name, end in zip(sequences, ends, strict=True)}

        def pairs(names: Collection[str], max_skip: int = 1) -> ScanPairs:
            poses = [T for name in names if (T := sequences[name].T_world_lidar) is not None]
            # One sequence without ground truth, and none is used: all pairs of a batch need the same entries.
            return ScanPairs([rows[name] for name in names], poses if len(poses) == len(names) else None, max_skip)

        self._train_pairs = pairs(self.data.train_sequences, self.augmentation.max_skip if self.augmentation else 1)
        if not len(self._train_pairs):
            raise UserError(
                f"{self.data.title}: no pair of scans to train on in sequences {list(self.data.train_sequences)}"
                "\n  change: data.train_sequences, or data.max_frames"
            )
        self.val_sequences = [sequences[name] for name in self.data.val_sequences]
        self._val_pairs = [pairs([name]) for name in self.data.val_sequences]
        if self.trainer is not None:
            self.keep_maps_on(self.trainer.strategy.root_device)

    def keep_maps_on(self, device: torch.device) -> None:
        """Copy all vertex maps to the training device if `resident` says so; `setup` calls it with the trainer's.

        Raises:
            UserError: the memory of the device is too small.
        """
        self._resident_maps, needed = None, self._maps.nbytes
        if self.resident is False or (self.resident == "auto" and needed > _RESIDENT_SHARE * _free_memory(device)):
            return
        try:
            self._resident_maps = self._maps.to(device)
        except torch.OutOfMemoryError as error:
            raise UserError(
                f"datamodule.resident=true: {needed / 1e9:.1f} GB of vertex maps do not fit into the memory of {device}"
                "\n  change: datamodule.resident=false, or train on fewer scans (data.max_frames)"
            ) from error

    def teardown(self, stage: str | None = None) -> None:
        """Release the memory of the device: another training may follow in the same process."""
        self._resident_maps = None

    def train_dataloader(self) -> DataLoader[Pair]:
        """Shuffled pairs of all training sequences; an incomplete last batch is dropped unless it is the only one."""
        processes = 1 if self.trainer is None else self.trainer.world_size
        pairs_each = math.ceil(len(self._train_pairs) / processes)  # the sampler repeats pairs to fill up
        return self._loader(self._train_pairs, shuffle=True, drop_last=pairs_each > self.batch_size)

    def val_dataloader(self) -> list[DataLoader[Pair]]:
        """One loader per validation sequence, in the order of `val_sequences`."""
        return [self._loader(pairs) for pairs in self._val_pairs]

    def on_after_batch_transfer(self, batch: Pair, dataloader_idx: int) -> Pair:
        """Complete a batch on the device, see `completed`."""
        return self.completed(batch, augmented=self.trainer is not None and bool(self.trainer.training))

    def completed(self, batch: Pair, augmented: bool) -> Pair:
        """A batch from a loader, already on the device, with the vertex maps in metres that the network takes.

        Args:
            batch: holds encoded maps, or rows of the resident ones.
            augmented: whether to augment it, as in training.
        """
        if self._resident_maps is not None:
            batch = with_maps(batch, self._resident_maps)
        batch = {**batch, "reference": cache.decode(batch["reference"]), "target": cache.decode(batch["target"])}
        return self.augmentation(batch) if augmented and self.augmentation is not None else batch

    def _vertex_maps(self, sequence: Sequence) -> cache.VertexMaps:
        return cache.cached_vertex_maps(sequence, self.projection, self.cache_root, self.preparation_workers)

    def _loader(self, pairs: ScanPairs, shuffle: bool = False, drop_last: bool = False) -> DataLoader[Pair]:
        is_resident = self._resident_maps is not None
        num_workers = 0 if is_resident else self.num_workers  # row numbers do not pay for another process
        return DataLoader(
            pairs,
            batch_size=self.batch_size,
            shuffle=shuffle,
            drop_last=drop_last,
            collate_fn=default_convert if is_resident else partial(with_maps, maps=self._maps),
            num_workers=num_workers,
            # Training starts new workers every epoch: their seeds come from the global random state, which a
            # checkpoint restores.
            persistent_workers=num_workers > 0 and not shuffle,
            # Validation starts its workers once per run, whether resumed or not: that must not use the global state.
            generator=None if shuffle else torch.Generator(),
            pin_memory=torch.cuda.is_available() and not is_resident,
        )


def _free_memory(device: torch.device) -> int:
    """Memory of a GPU that is not in use [B]; 0 for a CPU, where copies of the mapped files gain nothing."""
    if device.type != "cuda":
        return 0
    return torch.cuda.mem_get_info(device)[0] + torch.cuda.memory_reserved(device) - torch.cuda.memory_allocated(device)


def _require_ground_truth(sequences: Mapping[str, Sequence]) -> None:
    without = [name for name, sequence in sequences.items() if sequence.T_world_lidar is None]
    if without:
        raise UserError(
            f"loss=supervised needs ground truth, and there is none of {', '.join(without)}.\n"
            "  change: data.train_sequences and data.val_sequences to sequences that have it, or loss=weighted_icp"
        )


def _usable_cores() -> int:
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
