"""Base of all data sets that are downloaded or recorded: a root with sequences below it, complete or in part."""

import itertools
from abc import abstractmethod
from dataclasses import dataclass, fields
from pathlib import Path

from jaxtyping import Float
from torch import Tensor

from lidarlearn.data.errors import ROOT_REMEDY, DataSetNotFoundError
from lidarlearn.data.layout import LayoutReport
from lidarlearn.data.scan_files import ScanFiles, examples, full_path, is_folder, subfolders
from lidarlearn.data.sequence import DataSet, Sequence
from lidarlearn.errors import UserError

_NO_SETTINGS = ("name", "scans", "T_world_lidar", "timestamps")


@dataclass(frozen=True, eq=False, kw_only=True)
class SequenceOnDisk(Sequence):
    """A sequence whose scans are files; a reader adds `scan`, and its settings as fields with a readable `repr`.

    Args:
        name: as on the command line.
        scans: its files.
        T_world_lidar: ground truth; None if there is none.
        timestamps: of the scans [s]; None if unknown.
        beam_correction_deg: angle by which every beam is raised.
    """

    name: str
    scans: ScanFiles
    T_world_lidar: Float[Tensor, "n 4 4"] | None
    timestamps: Float[Tensor, "n"] | None
    beam_correction_deg: float

    def __len__(self) -> int:
        return len(self.scans)

    @property
    def fingerprint(self) -> str:
        """Digest of the reader, its settings and the files, without poses and times, which are no part of a scan."""
        given = {f.name: getattr(self, f.name) for f in fields(self) if f.init and f.name not in _NO_SETTINGS}
        settings = {name: value for name, value in given.items() if not isinstance(value, Tensor)}
        return self.scans.fingerprint(type(self).__name__, **settings)


class DataSetOnDisk(DataSet):
    """A data set in its published files.

    Attributes:
        source: where the data comes from.
        marker: what the right root holds, for error messages.
    """

    source: str
    marker: str
    check_opens = True

    @staticmethod
    @abstractmethod
    def is_root(path: Path) -> bool:
        """Whether a folder is at the level that `root` must have."""

    @abstractmethod
    def found(self) -> dict[str, ScanFiles]:
        """All sequences below the root, configured or not, with their scans."""

    @abstractmethod
    def check_sequence(self, report: LayoutReport, name: str) -> None:
        """Add findings about a configured sequence, from the names and sizes of its files."""

    def check(self) -> LayoutReport:
        """Describe this copy by names and sizes; if these are in order, open each configured sequence.

        Opening reads times, poses, calibration (see `open_for_check`) and the first scan.
        """
        report = LayoutReport()
        self._check_root(report)
        if not report.usable:
            return report
        found = self._with_scans()
        for name in self.names:
            self.check_sequence(report, name)
        for name in found:
            if name not in self.names:
                report.found(name, f"there ({len(found[name])} files), but not among the configured sequences")
        if report.usable:
            self.open_all(report)
        else:
            report.remedy = (
                "complete what is missing, or name only sequences that are there"
                f" ({examples(found) or 'none'}) in data.train_sequences, data.val_sequences and data.test_sequences"
            )
        return report

    def not_found(self, name: str, missing: str) -> DataSetNotFoundError:
        """The error for a sequence that lacks something, with a hint at what exists instead.

        Args:
            name: of the sequence.
            missing: what was not found.
        """
        near = None if self.is_root(self.root) else self._root_nearby()
        found = self._with_scans()
        if near is not None:
            remedy = f"wrong folder level, data.root={near} looks right"
        elif found and name not in found:
            remedy = (
                f"{self.settings_naming(name)} to sequences that are there ({examples(found)}),"
                " or data.root=/path/to/a/fuller/copy"
            )
        else:
            remedy = ROOT_REMEDY
        return DataSetNotFoundError(self.title, missing, self.root, self.source, remedy)

    def refuse_deskew(self) -> None:
        """Raise a UserError if compensated scans are to be deskewed, which would distort them."""
        if self.deskew:
            raise UserError(f"{self.title}: its scans are motion compensated already.\n  change: data.deskew=false")

    def require_scans(self, name: str, scans: ScanFiles, pattern: str) -> None:
        """Raise DataSetNotFoundError if a sequence has no scans; `pattern` of their names is for the message."""
        if not len(scans):
            raise self.not_found(name, f"{scans.folder.relative_to(self.root)}/{pattern}{scans.misnamed}")

    def require_file(self, name: str, path: Path) -> Path:
        """The path of a file that a sequence needs.

        Raises:
            DataSetNotFoundError: there is no such file.
        """
        if not path.is_file():
            raise self.not_found(name, str(path.relative_to(self.root)))
        return path

    def _check_root(self, report: LayoutReport) -> None:
        """Note whether the root is at the right folder level, or which folder seems to be."""
        if self.is_root(self.root):
            report.found("root", str(self.root))
        elif near := self._root_nearby():
            report.missing("root", f"wrong folder level: {self.root} holds no {self.marker}, but {near} does")
            report.remedy = f"data.root={near}"
        else:
            seen = f"{self.root} holds no {self.marker}" if is_folder(self.root) else f"{self.root}: no such folder"
            report.missing("root", seen)
            report.remedy = f"{ROOT_REMEDY}; get the data from {self.source}"

    def _root_nearby(self) -> Path | None:
        """The folder up to two levels below or above a wrong root that looks like the right one.

        None if there is no such folder, or if `root` does not exist: then its surroundings mean nothing.
        """
        if not is_folder(self.root):
            return None
        below = subfolders(self.root)
        grandchildren = (path for folder in below for path in subfolders(folder))
        nearby = itertools.chain(below, grandchildren, list(full_path(self.root).parents)[:2])
        return next((path for path in nearby if self.is_root(path)), None)

    def _with_scans(self) -> dict[str, ScanFiles]:
        """The existing sequences with at least one scan."""
        return {name: scans for name, scans in self.found().items() if len(scans)}
