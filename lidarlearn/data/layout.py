"""The report of a layout check: what a copy of a data set holds, from names, sizes and numbers of rows."""

from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from lidarlearn.data.scan_files import ScanFiles, examples, gaps

Level = Literal["found", "odd", "missing"]


@dataclass(frozen=True)
class Finding:
    """One line of a layout check: how bad it is, what was checked, and what was found."""

    level: Level
    what: str
    detail: str


@dataclass
class LayoutReport:
    """What a copy of a data set holds, what it lacks and what looks odd.

    Args:
        usable: whether the data can be used as configured.
        findings: in the order in which they were made.
        remedy: what to change if it is not usable; "" if the findings say enough.
    """

    usable: bool = True
    findings: list[Finding] = field(default_factory=list)
    remedy: str = ""

    def found(self, what: str, detail: str) -> None:
        """Add something that is as it should be."""
        self.findings.append(Finding("found", what, detail))

    def odd(self, what: str, detail: str) -> None:
        """Add something unexpected that does not prevent use."""
        self.findings.append(Finding("odd", what, detail))

    def missing(self, what: str, detail: str) -> None:
        """Add something without which the data cannot be used as configured."""
        self.findings.append(Finding("missing", what, detail))
        self.usable = False

    def absent(self, what: str, detail: str, needed: bool) -> None:
        """Add something that is not there: `missing` if the data cannot be used without it, else `odd`."""
        (self.missing if needed else self.odd)(what, detail)

    def describe_scans(self, name: str, scans: ScanFiles, bytes_per_point: int | None, smallest_bytes: int = 1) -> None:
        """Note the number of scans, gaps in their numbering, and truncated files.

        Args:
            name: of the sequence.
            scans: its files.
            bytes_per_point: every size must be a multiple of it; None if it is not fixed.
            smallest_bytes: size of the smallest file that can hold a scan.
        """
        if not len(scans):
            self.missing(name, f"no scans in {scans.folder}{scans.misnamed}")
            return
        self.found(name, f"{len(scans)} scans, {scans.names[0]} to {scans.names[-1]}")
        if scans.others:
            shown = examples(map(repr, scans.others))
            self.odd(name, f"{len(scans.others)} files that are not named like scans are left out: {shown}")
        sizes = np.array(scans.sizes)
        broken = (sizes < smallest_bytes) | (sizes % (bytes_per_point or 1) != 0)
        if broken.any():
            self.missing(name, f"{broken.sum()} empty or truncated files: {_files(scans, broken)}")
        small = ~broken & (sizes < np.median(sizes) / 4)
        if small.any():
            self.odd(name, f"{small.sum()} files less than a quarter of the usual size: {_files(scans, small)}")
        if scans.counted and (holes := gaps(scans.numbers)):
            shown = examples(str(a) if a == b else f"{a}-{b}" for a, b in holes)
            self.odd(name, f"{len(holes)} gaps in the numbering: {shown}")

    def describe_rows(self, name: str, path: Path, what: str, rows_needed: int, needed: bool = False) -> None:
        """Note a text file with a row for each number of a scan.

        Args:
            name: of the sequence.
            path: of the file.
            what: what its rows are, in the plural.
            rows_needed: one more than the greatest number of a scan.
            needed: whether the data cannot be used without the file.
        """
        if not path.is_file():
            self.absent(name, f"no {what}: {path} not found", needed)
            return
        rows = _count_rows(path)
        if rows < rows_needed:
            self.missing(name, f"{rows} {what} in {path.name}, fewer than the {rows_needed} that the scans need")
        elif rows > rows_needed:
            self.found(name, f"{rows} {what}, of which the scans need the first {rows_needed} (a partial copy)")
        else:
            self.found(name, f"{rows} {what}")

    def describe_ground_truth(self, name: str, path: Path | None, needed: bool = False) -> None:
        """Note a file of poses with times of their own, or that there is none.

        Args:
            name: of the sequence.
            path: of the file; None if there is none, under any of several names.
            needed: whether the data cannot be used without the file.
        """
        if path is None or not path.is_file():
            expected = "" if path is None else f" in {path}"
            lost = "errors will not be defined, and the supervised loss cannot be used"
            self.absent(name, f"no ground truth{expected}: {lost}", needed)
        elif rows := _count_rows(path):
            self.found(name, f"ground truth in {path} with {rows} rows")
        else:
            self.missing(name, f"empty ground truth: {path}")


def _count_rows(path: Path) -> int:
    """Number of lines of a text file without blank ones at the end; blank lines within stand for dropped frames."""
    with path.open("rb") as file:
        return max((number for number, line in enumerate(file, start=1) if line.strip()), default=0)


def _files(scans: ScanFiles, chosen: NDArray[np.bool_]) -> str:
    return examples(f"{scans.names[i]} ({scans.sizes[i]} bytes)" for i in np.flatnonzero(chosen))
