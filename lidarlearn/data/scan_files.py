"""Folders of scan files, listed by names and sizes alone, and reading of plain binary files."""

import hashlib
import itertools
import logging
import os
import re
from collections.abc import Iterable
from dataclasses import dataclass, replace
from decimal import Decimal
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from lidarlearn.data.errors import DamagedFileError
from lidarlearn.errors import UserError

_log = logging.getLogger(__name__)

_SHOWN = 5  # examples listed before "..."
_STAMP = r"[1-9]\d{9}"  # start of s, ms, us or ns since 1970; scan numbers of ten digits start with zeros


@dataclass(frozen=True)
class ScanFiles:
    """The scan files of one folder in the order of time.

    Args:
        folder: where they are.
        names: file names, in natural order: 9 before 10, 1583836592.119722 before 1583836592.22498.
        sizes: of each file [bytes].
        others: files of the same kind in the folder that are not named like scans.
        like: example of a scan's name, for error messages; "" if any name will do.
    """

    folder: Path
    names: tuple[str, ...]
    sizes: tuple[int, ...]
    others: tuple[str, ...] = ()
    like: str = ""

    def __len__(self) -> int:
        return len(self.names)

    @property
    def misnamed(self) -> str:
        """If no file is named like a scan, what is there instead: " (3 files there, none named like ...)", else ""."""
        if self.names or not self.others:
            return ""
        return f" ({len(self.others)} files there, none named like {self.like}: {examples(map(repr, self.others))})"

    def path(self, index: int) -> Path:
        """Path of one scan."""
        return self.folder / self.names[index]

    @property
    def numbers(self) -> list[int]:
        """The last number in each file's name, by which data sets count their scans; -1 if there is none."""
        return [int(found[-1]) if (found := re.findall(r"\d+", Path(name).stem)) else -1 for name in self.names]

    @property
    def counted(self) -> bool:
        """Whether names are numbers of scans rather than times."""
        return not any(re.search(_STAMP, name) for name in self.names)

    def select(self, indices: Iterable[int]) -> "ScanFiles":
        """Only some of the files, in the order given."""
        chosen = list(indices)
        return replace(self, names=tuple(self.names[i] for i in chosen), sizes=tuple(self.sizes[i] for i in chosen))

    def first(self, count: int | None) -> "ScanFiles":
        """The first `count` files; all of them for None."""
        return replace(self, names=self.names[:count], sizes=self.sizes[:count])

    def fingerprint(self, reader: str, **settings: Any) -> str:
        """Digest of the reader, its settings and the files, wherever the folder lies.

        It covers the names and sizes of all files, and the contents of the first, the middle and the last one, since
        organized clouds all have the same size.

        Raises:
            DamagedFileError: one of the three cannot be read.
        """
        digest = hashlib.sha256(repr((reader, sorted(settings.items()), self.names, self.sizes)).encode())
        for index in sorted({0, len(self) // 2, len(self) - 1}) if self.names else ():
            digest.update(read_bytes(self.path(index)))
        return digest.hexdigest()


def list_scans(folder: Path, suffixes: tuple[str, ...], stems: str = ".*", like: str = "") -> ScanFiles:
    """The scan files of a folder without hidden ones; none if the folder is absent.

    Reads only names and sizes, which takes a tenth of a second for 20,000 files.

    Args:
        folder: where they are.
        suffixes: of their names.
        stems: regular expression of the names without suffix; a copy `000002 (1).bin` is no scan of KITTI's.
        like: example of a name.
    """
    found = [(e.name, e.stat().st_size) for e in _entries(folder) if _is_scan(e, suffixes)]
    number = _numbers_in(name for name, _ in found)
    found.sort(key=lambda file: natural_key(file[0], number))
    scans = [(name, size) for name, size in found if re.fullmatch(stems, Path(name).stem)]
    others = {name for name, _ in found}.difference(name for name, _ in scans)
    names, sizes = tuple(n for n, _ in scans), tuple(size for _, size in scans)
    return ScanFiles(folder, names, sizes, tuple(sorted(others)), like)


def holds_scans(folder: Path, suffixes: tuple[str, ...]) -> bool:
    """Whether a folder has at least one file with one of the suffixes directly in it."""
    return any(_is_scan(entry, suffixes) for entry in _entries(folder))


def _is_scan(entry: "os.DirEntry[str]", suffixes: tuple[str, ...]) -> bool:
    return entry.name.lower().endswith(suffixes) and not entry.name.startswith(".") and os.path.isfile(entry.path)


def subfolders(folder: Path) -> list[Path]:
    """The folders directly below one, in natural order; none if it is absent.

    Hidden ones and those without permission to read, such as lost+found, are left out.
    """
    shown = (e.path for e in _entries(folder) if not e.name.startswith("."))
    found = (Path(path) for path in shown if os.path.isdir(path) and os.access(path, os.R_OK | os.X_OK))
    return sorted(found, key=lambda path: natural_key(path.name))


def is_folder(path: Path) -> bool:
    """Whether there is a folder; false without permission to look.

    `Path.is_dir` raises PermissionError then; so does `os.DirEntry.is_dir`, which also raises for circular links.
    """
    return os.path.isdir(path)


def full_path(path: Path) -> Path:
    """The absolute path without `..`, whose `name` is that of the folder and whose `parent` is the one above."""
    return Path(os.path.abspath(path))


def _entries(folder: Path) -> list["os.DirEntry[str]"]:
    """The entries of a folder; none if it is absent or cannot be read."""
    if not is_folder(folder) or not os.access(folder, os.R_OK):
        return []
    with os.scandir(folder) as entries:
        return list(entries)


def examples(items: Iterable[str]) -> str:
    """The first few of a list, for a message."""
    first = list(itertools.islice(items, _SHOWN + 1))
    return ", ".join(first[:_SHOWN]) + (", ..." if len(first) > _SHOWN else "")


def natural_key(name: str, number: str = r"\d+") -> tuple[list[tuple[Decimal, str]], str]:
    """Sorting key under which numbers count by value: scan_9 before scan_10.

    Args:
        name: to be sorted.
        number: regular expression of a number.
    """
    parts = re.split(f"({number})", name)
    return [(Decimal(part), "") if i % 2 else (Decimal(-1), part) for i, part in enumerate(parts)], name


def _numbers_in(names: Iterable[str]) -> str:
    """Regular expression of the numbers in names; with decimals if they are seconds that Python printed as floats.

    Floats lack trailing zeros: .22498 comes after .119722. Such a float has at most seven decimals; eight or more are
    nanoseconds, which some tools print without leading zeros: there .119722000 comes after .22498.
    """
    of_nanoseconds = any(re.search(rf"{_STAMP}\.\d{{8}}", name) for name in names)
    return r"\d+" if of_nanoseconds else rf"{_STAMP}\.\d+|\d+"


def sequence_names(names: Iterable[str | int] | str | int, digits: int = 0) -> tuple[str, ...]:
    """Sequence names from a setting; a bare number gets its leading zeros back (`[09,10]` arrives as "09", 10).

    Args:
        names: several names, or a single one.
        digits: to which numbers are zero-padded.

    Raises:
        UserError: a name is a path: runs name files after sequences, and these must stay in the run's folder.
    """
    several = [names] if isinstance(names, (str, int)) else names
    found = tuple(f"{name:0{digits}d}" if isinstance(name, int) else str(name) for name in several)
    for name in found:
        if name in ("", ".", "..") or "/" in name or "\\" in name:
            raise UserError(f"{name!r} is no name of a sequence.\n  change: data.root to the folder that holds it")
    return found


def gaps(numbers: list[int]) -> list[tuple[int, int]]:
    """First and last number of each gap in ascending numbers."""
    return [(a + 1, b - 1) for a, b in itertools.pairwise(numbers) if b > a + 1]


def warn_of_gaps(sequence: str, scans: ScanFiles) -> None:
    """Warn of gaps in the numbering of a sequence's scans, where neighbours are more than a period apart."""
    if holes := gaps(scans.numbers):
        _log.warning(
            "%s: %d gaps in the numbering of the scans in %s, the first from %d to %d",
            sequence, len(holes), scans.folder, *holes[0],
        )  # fmt: skip


def read_float32_rows(path: Path, columns: int) -> Float[Tensor, "n c"]:
    """Read a file of float32 rows, such as KITTI's x, y, z [m], reflectance in [0, 1].

    Raises:
        DamagedFileError: absent, empty, truncated, or not finite.
    """
    data = read_bytes(path, bytes_per_point=4 * columns)
    rows = torch.from_numpy(np.frombuffer(data, "<f4").reshape(-1, columns))
    if not rows.isfinite().all():
        bad = int((~rows.isfinite()).any(dim=1).sum())
        raise DamagedFileError(path, f"{bad} of {len(rows)} points are not finite")
    return rows


def read_bytes(path: Path, bytes_per_point: int = 1) -> bytearray:
    """Read a file of points; the content is writable, so that tensors can share its memory.

    Raises:
        DamagedFileError: absent, empty, or its size is not a multiple of a point's.
    """
    try:
        data = bytearray(path.read_bytes())
    except OSError as error:
        raise DamagedFileError(path, f"cannot be read: {error.strerror}") from error
    if not data:
        raise DamagedFileError(path, "the file is empty")
    if len(data) % bytes_per_point:
        raise DamagedFileError(
            path, f"truncated: its {len(data)} bytes are no multiple of the {bytes_per_point} bytes of a point"
        )
    return data
