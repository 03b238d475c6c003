"""Vertex maps on disk: each scan is read and projected once; every epoch reads the memory-mapped files."""

import errno
import hashlib
import json
import math
import os
import shutil
import warnings
from bisect import bisect_right
from collections.abc import Iterable
from dataclasses import asdict
from itertools import accumulate
from pathlib import Path
from typing import Literal

import numpy as np
import torch
from jaxtyping import Float, Int, Int16
from torch import Tensor
from torch.utils.data import DataLoader, Dataset, default_collate

from lidarlearn.data.locked import locked
from lidarlearn.data.sequence import Sequence
from lidarlearn.data.writable import writable
from lidarlearn.errors import UserError
from lidarlearn.geometry.projection import SphericalProjection
from lidarlearn.progress import tracked
from lidarlearn.source_digest import source_digest

QUANTUM_M = 0.004
"""Coordinates are stored as multiples of this [m]: less than the noise of sensors, and 16 bits reach 131 m."""

_MAPS, _DONE = "vertex_maps.npy", "done.npy"
_CHUNK = 32  # scans between two updates of `done.npy`: at most this many are projected again after a kill
_SPARE_BYTES = 50_000_000  # to be left free on the disk
_REMEDY = "datamodule.cache_root=/path/with/room, or the environment variable LIDARLEARN_CACHE"
_MAKE_ROOM = f"\n  change: {_REMEDY}, or train on fewer scans (data.max_frames)"


class VertexMaps:
    """The memory-mapped vertex maps of several sequences, one after another; pickled as the paths of their files.

    Args:
        files: a .npy file for each sequence, of shape (n, 3, h, w), int16.
    """

    def __init__(self, *files: Path) -> None:
        self.files = files
        # read-only: writable maps count as allocated memory, and they may exceed what there is
        self._maps = [np.load(file, mmap_mode="r") for file in files]
        self._ends = list(accumulate(map(len, self._maps)))

    def __len__(self) -> int:
        return self._ends[-1] if self._ends else 0

    def __getitem__(self, rows: Int[Tensor, "*batch"] | int) -> Int16[Tensor, "*batch 3 h w"]:
        rows = torch.as_tensor(rows)
        # default_collate stacks directly into shared memory when in a worker: each map is copied once
        maps = default_collate([self._one(row) for row in rows.flatten().tolist()])
        return maps.reshape(*rows.shape, *maps.shape[1:])

    def __reduce__(self) -> tuple[type["VertexMaps"], tuple[Path, ...]]:
        return VertexMaps, self.files

    @property
    def nbytes(self) -> int:
        """Size of all vertex maps [B]."""
        return sum(maps.nbytes for maps in self._maps)

    def to(self, device: torch.device) -> Int16[Tensor, "n 3 h w"]:
        """All vertex maps, copied to the memory of a device."""
        resident = torch.empty(len(self), *self._maps[0].shape[1:], dtype=torch.int16, device=device)
        for row in tracked(range(len(self)), f"vertex maps to {device}", len(self)):
            resident[row] = self._one(row)
        return resident

    def _one(self, row: int) -> Int16[Tensor, "3 h w"]:
        sequence = bisect_right(self._ends, row)
        with warnings.catch_warnings():
            warnings.filterwarnings("ignore", "The given NumPy array is not writable")  # it is only read
            return torch.from_numpy(self._maps[sequence][row - self._ends[sequence]])  # a negative index, from its end


def encode(vertex_map: Float[Tensor, "*batch 3 h w"]) -> Int16[Tensor, "*batch 3 h w"]:
    """Convert metres to multiples of `QUANTUM_M`; points beyond the range of 16 bits become empty pixels."""
    multiples = (vertex_map / QUANTUM_M).round()
    inside = (multiples.abs() <= torch.iinfo(torch.int16).max).all(dim=-3, keepdim=True)
    return torch.where(inside, multiples, 0).to(torch.int16)


def decode(multiples: Int16[Tensor, "*batch 3 h w"]) -> Float[Tensor, "*batch 3 h w"]:
    """Convert multiples of `QUANTUM_M` to metres, float32; empty pixels stay exactly zero."""
    return multiples * QUANTUM_M  # torch promotes integers times a float to float32 in one pass


def cached_vertex_maps(
    sequence: Sequence, projection: SphericalProjection, cache_root: Path, num_workers: int = 0
) -> VertexMaps:
    """The vertex maps of all scans of a sequence; those that are not on disk yet are projected now.

    The name of the folder is a fingerprint of the scans, the projection, and the code that reads and projects: other
    settings get another cache, and so does a changed reader. Caches of earlier code stay in `cache_root`, 280 kB a
    scan; `settings.json` in each folder names its sequence, and any folder may be deleted at any time.

    Several processes may ask at the same time: one projects, the others wait. If it is killed, the next one continues
    where it stopped.

    Args:
        sequence: provides the scans.
        projection: the image to project them into.
        cache_root: folder of all caches; created if missing.
        num_workers: processes that read and project; 0 does so in this one.

    Raises:
        DamagedFileError: a scan cannot be read.
        UserError: the disk is too small or cannot be written to.
    """
    folder, shape = _folder_and_shape(sequence, projection, cache_root)
    if not _complete(folder, shape):
        writable(folder, _REMEDY)
        with locked(folder / ".lock", f"sequence {sequence.name}: waiting for another process that projects it"):
            if not _complete(folder, shape):
                _build(folder, shape, sequence, projection, num_workers)
    return VertexMaps(folder / _MAPS)


def require_room(sequences: Iterable[Sequence], projection: SphericalProjection, cache_root: Path) -> None:
    """Raise a UserError unless the disk has room for all vertex maps that are still missing."""
    missing = sum(_missing_bytes(*_folder_and_shape(sequence, projection, cache_root)) for sequence in sequences)
    if not missing:
        return
    free = shutil.disk_usage(writable(cache_root, _REMEDY)).free
    if free < missing + _SPARE_BYTES:
        raise UserError(
            f"{cache_root.absolute()}: {free / 1e9:.2f} GB are free, and the vertex maps to be made take"
            f" {missing / 1e9:.2f} GB, beside {_SPARE_BYTES / 1e9:.2f} GB that are left to others.{_MAKE_ROOM}"
        )


def _folder_and_shape(
    sequence: Sequence, projection: SphericalProjection, cache_root: Path
) -> tuple[Path, tuple[int, ...]]:
    """Folder of a sequence's cache, and the shape of its vertex maps."""
    shape = (len(sequence), 3, projection.height, projection.width)
    return cache_root / _fingerprint(sequence, projection), shape


def _missing_bytes(folder: Path, shape: tuple[int, ...]) -> int:
    """Disk space that a cache still needs, beyond what is reserved for it."""
    if _complete(folder, shape):
        return 0
    file = folder / _MAPS
    reserved = file.stat().st_blocks * 512 if _opened(file, shape, np.int16) is not None else 0
    return max(math.prod(shape) * np.dtype(np.int16).itemsize - reserved, 0)


def _fingerprint(sequence: Sequence, projection: SphericalProjection) -> str:
    settings = json.dumps([_code(sequence), QUANTUM_M, sequence.fingerprint, len(sequence), asdict(projection)])
    return hashlib.sha256(settings.encode()).hexdigest()[:24]


def _code(sequence: Sequence) -> str:
    """Digest of the code of the sequence's reader and of this module, with all that they import."""
    return source_digest(type(sequence), Path(__file__))


def _complete(folder: Path, shape: tuple[int, ...]) -> bool:
    maps, done = _opened(folder / _MAPS, shape, np.int16), _opened(folder / _DONE, shape[:1], np.bool_)
    return maps is not None and done is not None and bool(done.all())


def _build(
    folder: Path, shape: tuple[int, ...], sequence: Sequence, projection: SphericalProjection, num_workers: int
) -> None:
    """Project the missing scans. They are flushed to disk before they are marked as done."""
    require_room([sequence], projection, folder.parent)
    if _opened(folder / _MAPS, shape, np.int16) is None:
        (folder / _DONE).unlink(missing_ok=True)  # it belonged to other maps
    maps = _opened_or_made(folder / _MAPS, shape, np.int16)
    done = _opened_or_made(folder / _DONE, shape[:1], np.bool_)
    settings = {"sequence": sequence.name, "fingerprint": sequence.fingerprint, "code": _code(sequence)}
    (folder / "settings.json").write_text(json.dumps(settings | asdict(projection), indent=2), encoding="utf-8")
    missing = np.flatnonzero(~done).tolist()
    scans = DataLoader(
        _ProjectedScans(sequence, projection, missing),
        batch_size=None,
        num_workers=min(num_workers, len(missing)),
        generator=torch.Generator(),  # not the global one: a training is the same with or without a cache
    )
    finished: list[int] = []
    for index, vertex_map in tracked(scans, f"projecting sequence {sequence.name}", len(missing)):
        if isinstance(vertex_map, UserError):
            raise vertex_map
        maps[index] = vertex_map.numpy()
        finished.append(index)
        if len(finished) % _CHUNK == 0 or len(finished) == len(missing):
            maps.flush()
            done[finished[-_CHUNK:]] = True
            done.flush()


def _opened(file: Path, shape: tuple[int, ...], dtype: type, mode: Literal["r", "r+"] = "r") -> np.memmap | None:
    """A memory-mapped .npy file; None if it is missing, truncated or holds something else."""
    try:
        array = np.lib.format.open_memmap(file, mode="r")  # "r+" would fill up a truncated file with zeros
        if array.shape != shape or array.dtype != dtype:
            return None
        return array if mode == "r" else np.lib.format.open_memmap(file, mode=mode)
    except (OSError, ValueError, EOFError):
        return None


def _opened_or_made(file: Path, shape: tuple[int, ...], dtype: type) -> np.memmap:
    """A .npy file mapped for writing, with all of its disk space allocated."""
    array = _opened(file, shape, dtype, "r+")
    if array is None:
        array = np.lib.format.open_memmap(file, mode="w+", dtype=dtype, shape=shape)
    _reserve(file)
    return array


def _reserve(file: Path) -> None:
    """Allocate the disk space of a file that will be mapped for writing: a new one is sparse.

    If the disk filled up, for example by other runs, writing to the map would kill the process without a message.

    Raises:
        UserError: there is not enough space; the file is deleted.
    """
    if not hasattr(os, "posix_fallocate"):  # macOS
        return
    try:
        with file.open("ab") as opened:
            os.posix_fallocate(opened.fileno(), 0, file.stat().st_size)
    except OSError as error:
        if error.errno in (errno.EOPNOTSUPP, errno.EINVAL):  # the file system cannot reserve space
            return
        size = file.stat().st_size
        file.unlink()
        raise UserError(
            f"{file.absolute()}: its {size / 1e9:.2f} GB cannot be reserved: {error.strerror}.{_MAKE_ROOM}"
        ) from error


class _ProjectedScans(Dataset[tuple[int, Tensor | UserError]]):
    """Encoded vertex maps of selected scans, with their indices; a `UserError` is returned in place of a map.

    If a worker raised it, it would arrive with the worker's stack trace as its message.
    """

    def __init__(self, sequence: Sequence, projection: SphericalProjection, indices: list[int]) -> None:
        self.sequence = sequence
        self.projection = projection
        self.indices = indices

    def __len__(self) -> int:
        return len(self.indices)

    def __getitem__(self, position: int) -> tuple[int, Tensor | UserError]:
        index = self.indices[position]
        try:
            return index, encode(self.projection.vertex_map(self.sequence.scan(index).points))
        except UserError as error:
            return index, UserError(str(error))
