"""What data sets that are downloaded or recorded have in common: a root with sequences below it, whole or in part."""

from abc import abstractmethod
from pathlib import Path

from lidarlearn.data import layout
from lidarlearn.data.errors import ROOT_REMEDY, DataSetNotFoundError, one_line
from lidarlearn.data.field_of_view import misfit
from lidarlearn.data.scan_files import ScanFiles
from lidarlearn.data.sequence import DataSet, LayoutReport, Sequence
from lidarlearn.errors import UserError


class DataSetOnDisk(DataSet):
    """A data set in the files in which it was published.

    Attributes:
        source: where the data comes from.
        marker: what the right root holds, for error messages.
    """

    source: str
    marker: str

    @staticmethod
    @abstractmethod
    def is_root(path: Path) -> bool:
        """Whether a folder is at the level that `root` has to be at."""

    @abstractmethod
    def found(self) -> dict[str, ScanFiles]:
        """All sequences below the root, configured or not, with their scans."""

    @abstractmethod
    def check_sequence(self, report: LayoutReport, name: str) -> None:
        """Add what the names and sizes of a configured sequence's files tell."""

    def open_for_check(self, name: str) -> Sequence:
        """Open a sequence as far as a check can wait for it."""
        return self.sequence(name)

    def check(self) -> LayoutReport:
        """Describe this copy by names and sizes; where these are in order, open each configured sequence.

        Opening reads times, poses and calibration as far as `open_for_check` goes, and the first scan.
        """
        report = LayoutReport()
        if layout.describe_root(report, self.root, self.is_root, self.marker, self.source):
            found = self._whole()
            for name in self.names:
                self.check_sequence(report, name)
            layout.describe_unconfigured(report, found, self.names)
            layout.suggest_sequences(report, found)
            if report.usable:
                self._open_all(report)
        return report

    def not_found(self, name: str, missing: str) -> DataSetNotFoundError:
        """The error for a sequence of which something is not there, with what there is instead.

        Args:
            name: of the sequence.
            missing: what was not found.
        """
        near = None if self.is_root(self.root) else layout.find_root(self.root, self.is_root)
        found = self._whole()
        if near is not None:
            remedy = f"wrong folder level, data.root={near} looks right"
        elif found and name not in found:
            remedy = (
                f"{self.settings_naming(name)} to sequences that are there ({', '.join(found)}),"
                " or data.root=/path/to/a/fuller/copy"
            )
        else:
            remedy = ROOT_REMEDY
        return DataSetNotFoundError(self.title, missing, self.root, self.source, remedy)

    def _whole(self) -> dict[str, ScanFiles]:
        """The sequences with at least one scan."""
        return {name: scans for name, scans in self.found().items() if len(scans)}

    def _open_all(self, report: LayoutReport) -> None:
        for name in self.names:
            try:
                points = self.open_for_check(name).scan(0).points
                remark = misfit(name, points, self.projection) if len(points) else "its first scan has no return"
            except UserError as problem:
                report.missing(name, one_line(problem))
            else:
                if remark is not None:
                    report.odd(name, one_line(remark))
