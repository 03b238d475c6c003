"""Vertex maps on disk: each scan is read and projected once, then mapped into memory at every epoch."""

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
"""Coordinates are stored in multiples of this [m]: below a sensor's noise, and 16 bits reach 131 m."""

_MAPS, _DONE = "vertex_maps.npy", "done.npy"
_CHUNK = 32  # frames between two notes of what is done: at most so many are projected again after a kill
_SPARE_BYTES = 50_000_000  # that are left to others
_REMEDY = "datamodule.cache_root=/path/with/room, or the environment variable LIDARLEARN_CACHE"
_MAKE_ROOM = f"\n  change: {_REMEDY}, or train on fewer scans (data.max_frames)"


class VertexMaps:
    """The vertex maps of sequences, one after another, mapped from files: no memory, and only paths travel to workers.

    Args:
        files: the .npy file of each sequence, of shape (n, 3, h, w), int16.
    """

    def __init__(self, *files: Path) -> None:
        self.files = files
        # for reading alone: maps that might be written to count as memory, of which they may exceed what there is
        self._maps = [np.load(file, mmap_mode="r") for file in files]
        self._ends = list(accumulate(map(len, self._maps)))

    def __len__(self) -> int:
        return self._ends[-1] if self._ends else 0

    def __getitem__(self, rows: Int[Tensor, "*batch"] | int) -> Int16[Tensor, "*batch 3 h w"]:
        rows = torch.as_tensor(rows)
        # torch's collation stacks them, in a worker directly in the memory that it shares: each map is copied once
        maps = default_collate([self._one(row) for row in rows.flatten().tolist()])
        return maps.reshape(*rows.shape, *maps.shape[1:])

    def __reduce__(self) -> tuple[type["VertexMaps"], tuple[Path, ...]]:
        return VertexMaps, self.files

    @property
    def nbytes(self) -> int:
        """Memory that all of them take."""
        return sum(maps.nbytes for maps in self._maps)

    def to(self, device: torch.device) -> Int16[Tensor, "n 3 h w"]:
        """All of them, in the memory of a device."""
        resident = torch.empty(len(self), *self._maps[0].shape[1:], dtype=torch.int16, device=device)
        for row in tracked(range(len(self)), f"vertex maps to {device}", len(self)):
            resident[row] = self._one(row)
        return resident

    def _one(self, row: int) -> Int16[Tensor, "3 h w"]:
        sequence = bisect_right(self._ends, row)
        with warnings.catch_warnings():
            warnings.filterwarnings("ignore", "The given NumPy array is not writable")  # and nobody writes to it
            return torch.from_numpy(self._maps[sequence][row - self._ends[sequence]])  # counted from its end


def encode(vertex_map: Float[Tensor, "*batch 3 h w"]) -> Int16[Tensor, "*batch 3 h w"]:
    """Metres to multiples of `QUANTUM_M`; points beyond the range of 16 bits become empty pixels."""
    multiples = (vertex_map / QUANTUM_M).round()
    inside = (multiples.abs() <= torch.iinfo(torch.int16).max).all(dim=-3, keepdim=True)
    return torch.where(inside, multiples, 0).to(torch.int16)


def decode(multiples: Int16[Tensor, "*batch 3 h w"]) -> Float[Tensor, "*batch 3 h w"]:
    """Multiples of `QUANTUM_M` to metres, float32; empty pixels stay exact zeros."""
    return multiples * QUANTUM_M  # of integers and a float torch makes float32, in one pass


def cached_vertex_maps(
    sequence: Sequence, projection: SphericalProjection, cache_root: Path, num_workers: int = 0
) -> VertexMaps:
    """The vertex maps of all scans of a sequence, projected now as far as they are not on disk yet.

    The folder's name is a fingerprint of the scans, of the projection, and of the code that reads and projects: other
    settings make another cache, and so does a changed reader. What earlier code made stays where it is, 280 kB a scan
    in `cache_root`; `settings.json` in each folder says of which sequence, and any folder may be deleted at any time.

    Any number of processes may ask at once: one projects, the others wait. A process killed half-way leaves what it
    had finished to the next one.

    Args:
        sequence: whose scans are projected.
        projection: the image to project them into.
        cache_root: folder of all caches; made where missing.
        num_workers: processes that read and project; 0 does it in this one.

    Raises:
        DamagedFileError: a scan cannot be read.
        UserError: the disk is too small, or cannot be written to.
    """
    folder, shape = _place(sequence, projection, cache_root)
    if not _complete(folder, shape):
        writable(folder, _REMEDY)
        with locked(folder / ".lock", f"sequence {sequence.name}: waiting for another process that projects it"):
            if not _complete(folder, shape):
                _build(folder, shape, sequence, projection, num_workers)
    return VertexMaps(folder / _MAPS)


def require_room(sequences: Iterable[Sequence], projection: SphericalProjection, cache_root: Path) -> None:
    """Raise UserError unless the disk has room for all vertex maps that the sequences still lack."""
    lacking = sum(_lacking_bytes(*_place(sequence, projection, cache_root)) for sequence in sequences)
    if not lacking:
        return
    free = shutil.disk_usage(writable(cache_root, _REMEDY)).free
    if free < lacking + _SPARE_BYTES:
        raise UserError(
            f"{cache_root.absolute()}: {free / 1e9:.2f} GB are free, and the vertex maps to be made take"
            f" {lacking / 1e9:.2f} GB, beside {_SPARE_BYTES / 1e9:.2f} GB that are left to others.{_MAKE_ROOM}"
        )


def _place(sequence: Sequence, projection: SphericalProjection, cache_root: Path) -> tuple[Path, tuple[int, ...]]:
    """Folder of a sequence's cache, and the shape of its vertex maps."""
    shape = (len(sequence), 3, projection.height, projection.width)
    return cache_root / _fingerprint(sequence, projection), shape


def _lacking_bytes(folder: Path, shape: tuple[int, ...]) -> int:
    """What a cache will take from the disk beyond what it has."""
    if _complete(folder, shape):
        return 0
    file = folder / _MAPS
    reserved = file.stat().st_blocks * 512 if _opened(file, shape, np.int16) is not None else 0
    return max(math.prod(shape) * np.dtype(np.int16).itemsize - reserved, 0)


def _fingerprint(sequence: Sequence, projection: SphericalProjection) -> str:
    settings = json.dumps([_code(sequence), QUANTUM_M, sequence.fingerprint, len(sequence), asdict(projection)])
    return hashlib.sha256(settings.encode()).hexdigest()[:24]


def _code(sequence: Sequence) -> str:
    """Digest of the sequence's reader and of this module, with all that they use."""
    return source_digest(type(sequence), Path(__file__))


def _complete(folder: Path, shape: tuple[int, ...]) -> bool:
    maps, done = _opened(folder / _MAPS, shape, np.int16), _opened(folder / _DONE, shape[:1], np.bool_)
    return maps is not None and done is not None and bool(done.all())


def _build(
    folder: Path, shape: tuple[int, ...], sequence: Sequence, projection: SphericalProjection, num_workers: int
) -> None:
    """Project what is missing. Frames are flushed to disk before they are noted as done."""
    require_room([sequence], projection, folder.parent)
    maps = _opened(folder / _MAPS, shape, np.int16, "r+")
    if maps is None:
        (folder / _DONE).unlink(missing_ok=True)  # it was said of other maps
        maps = np.lib.format.open_memmap(folder / _MAPS, mode="w+", dtype=np.int16, shape=shape)
    _reserve(folder / _MAPS)
    done = _opened(folder / _DONE, shape[:1], np.bool_, "r+")
    if done is None:
        done = np.lib.format.open_memmap(folder / _DONE, mode="w+", dtype=np.bool_, shape=shape[:1])
    _reserve(folder / _DONE)
    (folder / "settings.json").write_text(
        json.dumps(
            {"sequence": sequence.name, "fingerprint": sequence.fingerprint, "code": _code(sequence)}
            | asdict(projection),
            indent=2,
        ),
        encoding="utf-8",
    )
    missing = np.flatnonzero(~done).tolist()
    scans = DataLoader(
        _ProjectedScans(sequence, projection, missing),
        batch_size=None,
        num_workers=min(num_workers, len(missing)),
        generator=torch.Generator(),  # leaves the global one alone: a training is the same with or without a cache
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
    """A .npy file mapped into memory; None where it is absent, truncated or holds something else."""
    try:
        array = np.lib.format.open_memmap(file, mode="r")  # mapped for writing, a short file would be filled with zeros
        if array.shape != shape or array.dtype != dtype:
            return None
        return array if mode == "r" else np.lib.format.open_memmap(file, mode=mode)
    except (OSError, ValueError, EOFError):
        return None


def _reserve(file: Path) -> None:
    """Take from the disk what a file needs that is mapped for writing, in which new ones have nothing but holes.

    A disk that fills up under a mapped file kills the process without a word, and other runs fill it at the same time.

    Raises:
        UserError: there is not so much; the file is deleted.
    """
    if not hasattr(os, "posix_fallocate"):  # macOS
        return
    try:
        with file.open("ab") as opened:
            os.posix_fallocate(opened.fileno(), 0, file.stat().st_size)
    except OSError as error:
        if error.errno in (errno.EOPNOTSUPP, errno.EINVAL):  # of a file system that cannot
            return
        size = file.stat().st_size
        file.unlink()
        raise UserError(
            f"{file.absolute()}: its {size / 1e9:.2f} GB cannot be reserved: {error.strerror}.{_MAKE_ROOM}"
        ) from error


class _ProjectedScans(Dataset[tuple[int, Tensor | UserError]]):
    """Encoded vertex maps of chosen scans. What the user can mend is handed over as a value.

    Raised in a worker it would come out as another type, with the worker's stack trace for its message.
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
