"""What all formats share: what they require of a drive, and its scans as files hold them."""

import glob
from abc import ABC, abstractmethod
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Generic, TypeVar

import torch
from jaxtyping import Float
from torch import Tensor

from lidarlearn.data.beam_correction import raise_beams
from lidarlearn.data.kitti_raw import sweep_times
from lidarlearn.data.sequence import DataSet, Scan, Sequence
from lidarlearn.data.writable import writable
from lidarlearn.errors import UserError
from lidarlearn.progress import tracked

PERIOD_S = 0.1
_SWEEP_TOLERANCE = 0.01  # of a revolution
_REMEDY = "to.root=/an/empty/folder"

Target = TypeVar("Target", bound=DataSet)


class Exporter(ABC, Generic[Target]):
    """Writes drives in the format of a data set.

    `target.sequence(name)` reads a drive back with the same points, times, intensities and poses. The target's settings
    are undone on the way: where its reader raises every beam by 0.205 deg, the beams are written 0.205 deg too low, as
    KITTI's are.

    Args:
        target: the data set, with the root to write to.

    Attributes:
        option: the value of `to=` on the command line.
        places: below the root, what belongs to one sequence alone; `{}` stands for its name, `*` for anything.
    """

    option: str
    places: tuple[str, ...] = ("{}",)

    def __init__(self, target: Target) -> None:
        self.target = target

    def export(self, drive: Sequence, name: str) -> None:
        """Write a drive as the sequence `name`.

        Raises:
            UserError: the format cannot hold the drive, or the sequence exists already.
        """
        self.require(drive, name)
        self.require_new(name)
        writable(self.target.root, _REMEDY)
        self.write(drive, name)

    @abstractmethod
    def require(self, drive: Sequence, name: str) -> None:
        """Raise UserError unless the format can hold the drive under this name."""

    @abstractmethod
    def write(self, drive: Sequence, name: str) -> None:
        """Write the files of a drive that `require` accepts."""

    def require_new(self, name: str) -> None:
        """Raise UserError if any file or folder of the sequence exists already."""
        for place in self.places:
            for path in self.target.root.glob(place.format(glob.escape(name.removesuffix("_sync")))):
                raise UserError(
                    f"{path.absolute()} is there already, and is not written over."
                    f"\n  change: {_REMEDY}, or move it away"
                )

    def scans(self, drive: Sequence, name: str) -> Iterator[Scan]:
        """All scans as files hold them, with a progress bar.

        Beams are lowered by as much as the target's reader raises them. An empty scan becomes a point at the origin,
        which stands for no return: a file without points would pass for a damaged one.
        """
        for scan in tracked(drive, f"writing sequence {name}", len(drive)):
            written = scan if len(scan.points) else _one_point(scan)
            yield replace(written, points=raise_beams(written.points, -self.target.beam_correction_deg))

    def ground_truth(self, drive: Sequence) -> Float[Tensor, "n 4 4"]:
        """The poses, for formats that need them.

        Raises:
            UserError: the drive has none.
        """
        if drive.T_world_lidar is None:
            raise UserError(
                f"{self.target.title} holds a pose for every scan, but {drive.name} has no ground truth."
                "\n  change: to=folder, or export a drive with ground truth"
            )
        return drive.T_world_lidar

    def require_compensated(self, drive: Sequence) -> None:
        """Raise UserError if motion distorts the scans: the format holds compensated ones."""
        if drive.first_returns().times is not None:
            raise UserError(
                f"{self.target.title} holds motion-compensated scans, but those of {drive.name} are distorted by"
                " motion.\n  change: data.motion_distortion=false for simulated drives, or to=kitti_raw, kitti_360 or"
                " folder"
            )

    def require_sweeps(self, drive: Sequence) -> None:
        """Raise UserError unless each point's time follows from its azimuth, as the format's reader assumes."""
        scan = drive.first_returns()
        if scan.times is None:
            raise UserError(
                f"{self.target.title} holds scans as the motion distorted them, but those of {drive.name} are"
                " compensated.\n  change: data.motion_distortion=true for simulated drives, or to=kitti_00-08"
            )
        difference = (scan.times - sweep_times(scan.points) + 0.5) % 1 - 0.5
        if difference.abs().max() > _SWEEP_TOLERANCE:
            raise UserError(
                f"{self.target.title} tells a point's time by its azimuth, clockwise from the rear; the times of"
                f" {drive.name} differ from that by up to {difference.abs().max():.2f} sweeps."
                "\n  change: to=folder, which holds times"
            )


def timestamps_of(drive: Sequence) -> Float[Tensor, "n"]:
    """Time of each scan [s]; ten scans per second if the drive has no times."""
    return PERIOD_S * torch.arange(len(drive), dtype=torch.float64) if drive.timestamps is None else drive.timestamps


def write_shared(path: Path, text: str) -> None:
    """Write a file that all sequences of a copy share.

    Raises:
        UserError: it exists with other content.
    """
    if path.is_file() and path.read_bytes() != text.encode():
        raise UserError(f"{path.absolute()} belongs to other sequences, and is not written over.\n  change: {_REMEDY}")
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(text, encoding="utf-8")


def _one_point(scan: Scan) -> Scan:
    """An empty scan with a point at the origin."""
    times, intensities = (None if part is None else torch.zeros(1) for part in (scan.times, scan.intensities))
    return Scan(torch.zeros(1, 3), times, intensities)
