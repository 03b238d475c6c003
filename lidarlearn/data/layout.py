"""Shared parts of the layout checks: describe files by names and sizes, and find the right folder level."""

import itertools
from collections.abc import Callable, Iterable, Mapping
from pathlib import Path

import numpy as np

from lidarlearn.data.errors import ROOT_REMEDY
from lidarlearn.data.scan_files import ScanFiles, examples, full_path, gaps, is_folder, subfolders
from lidarlearn.data.sequence import LayoutReport
from lidarlearn.errors import UserError


def find_root(root: Path, is_root: Callable[[Path], bool]) -> Path | None:
    """The folder that looks like the root of a data set: `root`, or up to two levels below or above it.

    None if there is no such folder, or if `root` itself does not exist: then its surroundings mean nothing.
    """
    if not is_folder(root):
        return None
    below = subfolders(root)
    grandchildren = (path for folder in below for path in subfolders(folder))
    candidates = itertools.chain([root], below, grandchildren, list(full_path(root).parents)[:2])
    return next((path for path in candidates if is_root(path)), None)


def describe_root(report: LayoutReport, root: Path, is_root: Callable[[Path], bool], marker: str, source: str) -> bool:
    """Note whether the root is at the right folder level, or which folder seems to be.

    Args:
        report: the report to extend.
        root: as configured.
        is_root: recognises the right level.
        marker: what the right level holds, for the message.
        source: where the data comes from.

    Returns:
        Whether the root is at the right level.
    """
    if is_root(root):
        report.found("root", str(root))
        return True
    near = find_root(root, is_root)
    if near is not None:
        report.missing("root", f"wrong folder level: {root} holds no {marker}, but {near} does")
        report.remedy = f"data.root={near}"
    else:
        report.missing("root", f"{root} holds no {marker}" if is_folder(root) else f"{root}: no such folder")
        report.remedy = f"{ROOT_REMEDY}; get the data from {source}"
    return False


def describe_scans(
    report: LayoutReport,
    name: str,
    scans: ScanFiles,
    bytes_per_point: int | None,
    smallest_bytes: int = 1,
) -> None:
    """Note the number of scans, gaps in their numbering, and truncated files.

    Args:
        report: the report to extend.
        name: of the sequence.
        scans: its files.
        bytes_per_point: every size must be a multiple of it; None if it is not fixed.
        smallest_bytes: size of the smallest file that can hold a scan.
    """
    if not len(scans):
        report.missing(name, f"no scans in {scans.folder}{scans.misnamed}")
        return
    report.found(name, f"{len(scans)} scans, {scans.names[0]} to {scans.names[-1]}")
    if scans.others:
        shown = examples(map(repr, scans.others))
        report.odd(name, f"{len(scans.others)} files that are not named like scans are left out: {shown}")
    sizes = np.array(scans.sizes)
    broken = (sizes < smallest_bytes) | (sizes % (bytes_per_point or 1) != 0)
    if broken.any():
        report.missing(name, f"{broken.sum()} empty or truncated files: {_files(scans, broken)}")
    small = ~broken & (sizes < np.median(sizes) / 4)
    if small.any():
        report.odd(name, f"{small.sum()} files less than a quarter of the usual size: {_files(scans, small)}")
    if scans.counted and (holes := gaps(scans.numbers)):
        shown = examples(str(a) if a == b else f"{a}-{b}" for a, b in holes)
        report.odd(name, f"{len(holes)} gaps in the numbering: {shown}")


def describe_rows(
    report: LayoutReport, name: str, path: Path, what: str, rows_needed: int, needed: bool = False
) -> None:
    """Note a text file with a row for each number of a scan.

    Args:
        report: the report to extend.
        name: of the sequence.
        path: of the file.
        what: what its rows are, in the plural.
        rows_needed: one more than the greatest number of a scan.
        needed: whether the data cannot be used without the file.
    """
    if not path.is_file():
        (report.missing if needed else report.odd)(name, f"no {what}: {path} not found")
        return
    rows = count_rows(path)
    if rows < rows_needed:
        report.missing(name, f"{rows} {what} in {path.name}, fewer than the {rows_needed} that the scans need")
    elif rows > rows_needed:
        report.found(name, f"{rows} {what}, of which the scans need the first {rows_needed} (a partial copy)")
    else:
        report.found(name, f"{rows} {what}")


def count_rows(path: Path) -> int:
    """Number of lines of a text file without blank ones at the end; blank lines within stand for dropped frames."""
    with path.open("rb") as file:
        return max((number for number, line in enumerate(file, start=1) if line.strip()), default=0)


def refuse_deskew(title: str, deskew: bool) -> None:
    """Raise UserError if compensated scans are to be deskewed, which would distort them."""
    if deskew:
        raise UserError(f"{title}: its scans are motion compensated already.\n  change: data.deskew=false")


def describe_unconfigured(report: LayoutReport, found: Mapping[str, ScanFiles], configured: Iterable[str]) -> None:
    """Note the sequences that exist but are not configured."""
    named = set(configured)
    for name, scans in found.items():
        if name not in named:
            report.found(name, f"there ({len(scans)} files), but not among the configured sequences")


def suggest_sequences(report: LayoutReport, found: Iterable[str]) -> None:
    """Set the report's remedy if some of the configured sequences cannot be used."""
    if report.usable or report.remedy:
        return
    there = examples(found)
    report.remedy = (
        "complete what is missing, or name only sequences that are there"
        f" ({there or 'none'}) in data.train_sequences, data.val_sequences and data.test_sequences"
    )


def _files(scans: ScanFiles, chosen: "np.ndarray[tuple[int], np.dtype[np.bool_]]") -> str:
    return examples(f"{scans.names[i]} ({scans.sizes[i]} bytes)" for i in np.flatnonzero(chosen))
