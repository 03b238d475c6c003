"""The two interfaces of every data set: a `Sequence` of scans, and the `DataSet` it belongs to."""

import logging
import os
from abc import ABC, abstractmethod
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path

import torch
from jaxtyping import Float
from torch import Tensor

from lidarlearn.data.contract import require_points, require_poses, require_timestamps
from lidarlearn.data.errors import one_line, require_count
from lidarlearn.data.field_of_view import field_of_view_warning
from lidarlearn.data.layout import LayoutReport
from lidarlearn.data.scan_files import sequence_names
from lidarlearn.errors import UserError
from lidarlearn.geometry.projection import SphericalProjection

_log = logging.getLogger(__name__)

Names = Iterable[str | int] | str | int


@dataclass(frozen=True)
class Scan:
    """One revolution of a spinning LiDAR.

    Args:
        points: float32 [m] in the sensor frame: x forward, y left, z up; finite.
        times: when each point was measured, as a share of the scan period relative to the instant of the scan's pose,
            e.g. in [-0.5, 0.5) if that is the middle of the sweep; None if scans are already motion compensated or
            have no times.
        intensities: reflectance as the sensor gives it, in [0, 1]; None if there is none.
    """

    points: Float[Tensor, "n 3"]
    times: Float[Tensor, "n"] | None = None
    intensities: Float[Tensor, "n"] | None = None


class Sequence(ABC):
    """A drive: its scans in order of time, and its ground truth if there is any.

    Opening a sequence finds its files and reads poses and times. Scans are read one by one, so that a sequence is cheap
    to pickle to worker processes.

    Attributes:
        name: as on the command line, e.g. "08".
        T_world_lidar: ground-truth poses (n, 4, 4), float64; the first one is the identity. None if there are none.
        timestamps: time of each scan [s] (n,), float64; None if unknown.
        T_reference_lidar: (4, 4) float64, from the LiDAR to the frame in which the data set publishes its poses and
            its metric is defined: the left camera for KITTI odometry, the LiDAR itself (identity) elsewhere.
        reference_frame: name of that frame, "camera" or "lidar".
    """

    name: str
    T_world_lidar: Float[Tensor, "n 4 4"] | None = None
    timestamps: Float[Tensor, "n"] | None = None
    T_reference_lidar: Float[Tensor, "4 4"] = torch.eye(4, dtype=torch.float64)
    reference_frame: str = "lidar"

    @abstractmethod
    def __len__(self) -> int:
        """Number of scans."""

    @abstractmethod
    def scan(self, index: int) -> Scan:
        """Read one scan.

        Raises:
            DamagedFileError: the file is truncated, empty or holds values that are not finite.
        """

    def first_returns(self) -> Scan:
        """The first scan that has a return, almost always the very first.

        Raises:
            UserError: no scan has a return.
        """
        found = next((scan for scan in self if len(scan.points)), None)
        if found is None:
            raise UserError(
                f"{self.name}: none of its {len(self)} scans has a single return.\n"
                "  change: data.train_sequences, data.val_sequences and data.test_sequences to leave it out"
            )
        return found

    def require_contract(self, first: Scan) -> None:
        """Raise a UserError unless poses, timestamps and a scan have the shapes and types documented above.

        Args:
            first: the first scan, or the first one with a return.
        """
        require_poses(self.name, self.T_world_lidar, len(self))
        require_timestamps(self.name, self.timestamps, len(self))
        require_points(self.name, first.points, first.times)

    @property
    @abstractmethod
    def fingerprint(self) -> str:
        """Identifies the scans by the settings of the reader and the files: it differs if any scan differs.

        It need not cover the reader's code, which caches identify by `source_digest`.
        """

    def __iter__(self) -> Iterator[Scan]:
        return (self.scan(i) for i in range(len(self)))


class DataSet(ABC):
    """A data set on disk: opens sequences by name, and divides them into training, validation and test sequences.

    The constructors of all data sets take the arguments below, so that a setting means the same for each of them. Their
    values differ: `configs/data/<name>.yaml` holds those of each data set.

    Attributes:
        title: of the data set, as its authors call it.
        digits: number of digits of a sequence name; names given as numbers are padded with zeros to it.
        check_opens: whether `check` opens the sequences itself, or must not; otherwise `full_check` opens them.

    Args:
        root: folder of the data set; `~` is the home folder.
        projection: the image of its sensor.
        train_sequences: names of the sequences to train on, or a single name.
        val_sequences: names of the sequences that select the best checkpoint.
        test_sequences: names of the sequences to evaluate.
        max_frames: keep only this many scans at the start of each sequence; None keeps all.
        deskew: whether odometries compensate the motion within a scan; only for scans with times.
        beam_correction_deg: angle by which each point is rotated to correct the intrinsic calibration [deg].

    Raises:
        UserError: `max_frames` is not a number of scans.
    """

    title: str
    digits: int = 0
    check_opens: bool = False

    def __init__(
        self,
        root: str | os.PathLike[str],
        projection: SphericalProjection,
        train_sequences: Names,
        val_sequences: Names,
        test_sequences: Names,
        max_frames: int | None,
        deskew: bool,
        beam_correction_deg: float | int,
    ) -> None:
        require_count("data.max_frames", max_frames, optional=True)
        self.root = Path(root).expanduser()
        self.projection = projection
        self.train_sequences = sequence_names(train_sequences, self.digits)
        self.val_sequences = sequence_names(val_sequences, self.digits)
        self.test_sequences = sequence_names(test_sequences, self.digits)
        self.max_frames = max_frames
        self.deskew = deskew
        self.beam_correction_deg = float(beam_correction_deg)

    @property
    def names(self) -> tuple[str, ...]:
        """The names of all configured sequences, each once."""
        return tuple(dict.fromkeys((*self.train_sequences, *self.val_sequences, *self.test_sequences)))

    def settings_naming(self, name: str) -> str:
        """The settings that name a sequence, for error messages."""
        settings = ("train_sequences", "val_sequences", "test_sequences")
        return ", ".join(f"data.{s}" for s in settings if name in getattr(self, s)) or "the name"

    def sequences(self, names: Iterable[str]) -> dict[str, Sequence]:
        """Open several sequences and check the first scan of each; warns if one of these does not fit into the image.

        Raises:
            DataSetNotFoundError, DamagedFileError: see `sequence`; or a first scan cannot be read.
            UserError: a sequence has no scan with a return, or violates the contract of `Sequence` and `Scan`.
        """
        opened = {name: self.sequence(name) for name in names}
        first = {name: sequence.first_returns() for name, sequence in opened.items()}
        for name, sequence in opened.items():
            sequence.require_contract(first[name])
        warnings = (self.field_of_view_warning(name, scan.points) for name, scan in first.items())
        if warning := next(filter(None, warnings), None):
            _log.warning(warning)
        return opened

    @abstractmethod
    def sequence(self, name: str) -> Sequence:
        """Open a sequence.

        Raises:
            DataSetNotFoundError: the sequence does not exist.
            DamagedFileError: its poses, times or calibration cannot be read.
        """

    @abstractmethod
    def check(self) -> LayoutReport:
        """Describe what this copy holds, lacks, and what looks odd; reads at most a few scans of each sequence."""

    def full_check(self) -> LayoutReport:
        """`check` and, if nothing is missing, whether each sequence keeps the contract of `Sequence` and `Scan`."""
        report = self.check()
        if report.usable and not self.check_opens:
            self.open_all(report)
        return report

    def open_all(self, report: LayoutReport) -> None:
        """Open each configured sequence for a check; report errors in its poses, times and first scan."""
        for name in self.names:
            try:
                sequence = self.open_for_check(name)
                scan = next(iter(sequence), None) or sequence.first_returns()  # which raises if there is no scan
                sequence.require_contract(scan)
                points = scan.points
                odd = self.field_of_view_warning(name, points) if len(points) else "its first scan has no return"
            except UserError as problem:
                report.missing(name, one_line(problem))
            else:
                if odd is not None:
                    report.odd(name, one_line(odd))

    def field_of_view_warning(self, name: str, points: Float[Tensor, "n 3"]) -> str | None:
        """A warning if many points of a sequence's first scan lie outside the image; None if they do not."""
        return field_of_view_warning(name, points, self.projection)

    def open_for_check(self, name: str) -> Sequence:
        """Open a sequence for a check; subclasses may skip what takes long."""
        return self.sequence(name)

    def prepare(self, names: Iterable[str] | None = None) -> None:  # noqa: B027 - most data sets have nothing to do
        """Make data that can be generated (simulated scans); called once, before any sequence is opened.

        Args:
            names: the sequences that will be opened; None for all configured ones.
        """
