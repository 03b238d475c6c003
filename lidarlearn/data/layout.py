"""Shared parts of the layout checks: describe files by their names, sizes and numbers of rows."""

from pathlib import Path

import numpy as np

from lidarlearn.data.scan_files import ScanFiles, examples, gaps
from lidarlearn.data.sequence import LayoutReport


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


def _files(scans: ScanFiles, chosen: "np.ndarray[tuple[int], np.dtype[np.bool_]]") -> str:
    return examples(f"{scans.names[i]} ({scans.sizes[i]} bytes)" for i in np.flatnonzero(chosen))
