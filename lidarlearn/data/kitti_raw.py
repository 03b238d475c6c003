"""KITTI raw: drives with an HDL-64 and an RTK GPS/IMU, not motion compensated.

On disk: `DATE/DATE_drive_NNNN_sync/{velodyne_points/{data/%010d.bin, timestamps_start.txt, timestamps_end.txt},
oxts/{data/%010d.txt, timestamps.txt}}` and `DATE/calib_imu_to_velo.txt`.

The laser turns clockwise seen from above, from the rear over the left side: a point's time follows from its azimuth.
A scan's pose is that of the middle of its sweep, when the laser faces forward: the GPS/IMU poses are interpolated
there (a packet lies 12 to 22 ms off; taking it as it stands doubles the disagreement with registered scans). Scans
keep their number where the recording dropped some; the dropped ones are blank lines in the time stamps.
"""

import math
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from lidarlearn.data import layout
from lidarlearn.data.beam_correction import raise_beams
from lidarlearn.data.errors import DamagedFileError, DataSetNotFoundError
from lidarlearn.data.interpolation import interpolate_poses
from lidarlearn.data.oxts import read_oxts_poses, read_rigid_transform, read_timestamps
from lidarlearn.data.pose_files import start_at_identity
from lidarlearn.data.scan_files import (
    ScanFiles,
    list_scans,
    read_float32_rows,
    sequence_names,
    subfolders,
    warn_of_gaps,
)
from lidarlearn.data.sequence import DataSet, LayoutReport, Scan, Sequence
from lidarlearn.geometry.projection import SphericalProjection

_SOURCE = "https://www.cvlibs.net/datasets/kitti/raw_data.php ([synced+rectified data] and [calibration] of a drive)"


@dataclass(frozen=True)
class Drive:
    """A drive of KITTI raw, or the part of it that is a sequence of KITTI odometry.

    Args:
        name: e.g. 2011_09_26_drive_0009.
        first: number of the first scan.
        last: number of the last scan, None for all.
    """

    name: str
    first: int = 0
    last: int | None = None


# Sequences of KITTI odometry by number. Source: readme.txt of the odometry development kit. 03 is no longer published.
ODOMETRY_DRIVES = {
    "00": Drive("2011_10_03_drive_0027", 0, 4540),
    "01": Drive("2011_10_03_drive_0042", 0, 1100),
    "02": Drive("2011_10_03_drive_0034", 0, 4660),
    "03": Drive("2011_09_26_drive_0067", 0, 800),
    "04": Drive("2011_09_30_drive_0016", 0, 270),
    "05": Drive("2011_09_30_drive_0018", 0, 2760),
    "06": Drive("2011_09_30_drive_0020", 0, 1100),
    "07": Drive("2011_09_30_drive_0027", 0, 1100),
    "08": Drive("2011_09_30_drive_0028", 1100, 5170),
    "09": Drive("2011_09_30_drive_0033", 0, 1590),
    "10": Drive("2011_09_30_drive_0034", 0, 1200),
}


@dataclass(frozen=True, eq=False, kw_only=True)
class KittiRawSequence(Sequence):
    """A drive of KITTI raw.

    Args:
        name: of the drive, or two digits for the part of it that KITTI odometry holds.
        scans: its files.
        T_world_lidar: from GPS and IMU; None where they are not there.
        timestamps: middle of each sweep [s], of the day's clock.
        beam_correction_deg: angle by which every beam is raised.
    """

    name: str
    scans: ScanFiles
    T_world_lidar: Float[Tensor, "n 4 4"] | None
    timestamps: Float[Tensor, "n"] | None
    beam_correction_deg: float

    def __len__(self) -> int:
        return len(self.scans)

    def scan(self, index: int) -> Scan:
        """Read one scan, with point times relative to the middle of the sweep."""
        rows = read_float32_rows(self.scans.path(index), columns=4)
        points = raise_beams(rows[:, :3], self.beam_correction_deg)
        return Scan(points, times=sweep_times(points), intensities=rows[:, 3].clamp(0, 1))

    @property
    def fingerprint(self) -> str:
        """Digest of the files and the beam correction."""
        return self.scans.fingerprint("KittiRaw", beam_correction_deg=self.beam_correction_deg)


class KittiRaw(DataSet):
    """KITTI raw.

    Args:
        root: the folder that holds the dates, e.g. 2011_09_26.
        projection: the image of the HDL-64.
        train_sequences: drives like 2011_09_26_drive_0009, or two digits for a sequence of KITTI odometry.
        val_sequences: likewise.
        test_sequences: likewise.
        max_frames: keep only the first scans of each sequence; None keeps all.
        deskew: whether odometries compensate the motion within a scan.
        beam_correction_deg: angle by which every beam is raised, 0 for scans as published.
    """

    title = "KITTI raw"

    def __init__(
        self,
        root: str | Path,
        projection: SphericalProjection,
        train_sequences: Iterable[str | int],
        val_sequences: Iterable[str | int],
        test_sequences: Iterable[str | int],
        max_frames: int | None = None,
        deskew: bool = True,
        beam_correction_deg: float | int = 0.205,
    ) -> None:
        self.root = Path(root)
        self.projection = projection
        self.train_sequences = sequence_names(train_sequences, digits=2)
        self.val_sequences = sequence_names(val_sequences, digits=2)
        self.test_sequences = sequence_names(test_sequences, digits=2)
        self.max_frames = max_frames
        self.deskew = deskew
        self.beam_correction_deg = float(beam_correction_deg)

    def sequence(self, name: str) -> KittiRawSequence:
        """Open a drive, or the part of one that is a sequence of KITTI odometry."""
        folder = self._folder(name)
        scans = self._scans(name).first(self.max_frames)
        if not len(scans):
            raise self._not_found(folder / "velodyne_points" / "data" / "*.bin")
        warn_of_gaps(name, scans)
        timestamps = self._timestamps(folder, scans)
        return KittiRawSequence(
            name=name,
            scans=scans,
            T_world_lidar=self._ground_truth(folder, timestamps),
            timestamps=timestamps,
            beam_correction_deg=self.beam_correction_deg,
        )

    def check(self) -> LayoutReport:
        """Describe this copy by names, sizes and the lengths of text files."""
        report = LayoutReport()
        if layout.describe_root(report, self.root, _is_root, "folder of a date with drives, like 2011_09_26", _SOURCE):
            configured = dict.fromkeys(self.train_sequences + self.val_sequences + self.test_sequences)
            for name in configured:
                self._check_sequence(report, name)
            drives = [drive.name.removesuffix("_sync") for date in subfolders(self.root) for drive in _drives(date)]
            there = {name: self._scans(name) for name in drives}
            layout.describe_unconfigured(report, there, [_drive(name).name for name in configured])
            layout.suggest_sequences(report, there)
        return report

    def _check_sequence(self, report: LayoutReport, name: str) -> None:
        folder = self._folder(name)
        if not folder.is_dir():
            report.missing(name, f"no folder {folder.relative_to(self.root)}")
            return
        scans = self._scans(name)
        layout.describe_scans(report, name, scans, bytes_per_point=16)
        rows_needed = max(scans.numbers, default=-1) + 1
        for end in ("start", "end"):
            stamps = folder / "velodyne_points" / f"timestamps_{end}.txt"
            layout.describe_rows(report, name, stamps, f"{end} times", rows_needed, needed=True)
        ground_truth_needed = name in self.test_sequences
        note = report.missing if ground_truth_needed else report.odd
        packets = len(list_scans(folder / "oxts" / "data", (".txt",)))
        if not packets:
            note(name, f"no ground truth: no files in {folder / 'oxts' / 'data'}")
            return
        layout.describe_rows(report, name, folder / "oxts" / "timestamps.txt", "GPS/IMU times", packets, needed=True)
        if not (folder.parent / "calib_imu_to_velo.txt").is_file():
            report.missing(name, f"no calibration {folder.parent.name}/calib_imu_to_velo.txt")

    def _folder(self, name: str) -> Path:
        drive = _drive(name).name
        return self.root / drive.partition("_drive_")[0] / f"{drive}_sync"

    def _scans(self, name: str) -> ScanFiles:
        drive = _drive(name)
        scans = list_scans(self._folder(name) / "velodyne_points" / "data", (".bin",))
        last = math.inf if drive.last is None else drive.last
        return scans.select(i for i, number in enumerate(scans.numbers) if drive.first <= number <= last)

    def _timestamps(self, folder: Path, scans: ScanFiles) -> Float[Tensor, "n"]:
        paths = [folder / "velodyne_points" / f"timestamps_{end}.txt" for end in ("start", "end")]
        for path in paths:
            if not path.is_file():
                raise self._not_found(path)
        start, end = (read_timestamps(path, scans.numbers) for path in paths)
        return (start + end) / 2

    def _ground_truth(self, folder: Path, timestamps: Float[Tensor, "n"]) -> Float[Tensor, "n 4 4"] | None:
        packets = list_scans(folder / "oxts" / "data", (".txt",))
        if not len(packets):
            return None
        for path in (folder / "oxts" / "timestamps.txt", folder.parent / "calib_imu_to_velo.txt"):
            if not path.is_file():
                raise self._not_found(path)
        times = read_timestamps(folder / "oxts" / "timestamps.txt", packets.numbers)
        if len(times) < 2 or (times.diff() <= 0).any():
            raise DamagedFileError(
                folder / "oxts" / "timestamps.txt", "fewer than two times, or times that do not ascend"
            )
        T_lidar_imu = read_rigid_transform(folder.parent / "calib_imu_to_velo.txt")
        # Only what the scans need: a drive has thousands of packets, one file each.
        used = (times >= timestamps.min() - 1) & (times <= timestamps.max() + 1)
        if int(used.sum()) < 2:
            raise DamagedFileError(
                folder / "oxts" / "timestamps.txt", "its times do not overlap with those of the scans"
            )
        T_world_imu = read_oxts_poses(packets.select(np.flatnonzero(used.numpy()).tolist()))
        T_world_lidar = T_world_imu @ torch.linalg.inv(T_lidar_imu)
        return start_at_identity(interpolate_poses(times[used], T_world_lidar, timestamps))

    def _not_found(self, path: Path) -> DataSetNotFoundError:
        return layout.not_found(self.title, str(path.relative_to(self.root)), self.root, _is_root, _SOURCE)


def sweep_times(points: Float[Tensor, "n 3"]) -> Float[Tensor, "n"]:
    """Time of each point as a share of the sweep, from -0.5 (at the rear, about to go left) over 0 (forward) to 0.5."""
    return -torch.atan2(points[:, 1], points[:, 0]) / (2 * math.pi)


def _drive(name: str) -> Drive:
    return ODOMETRY_DRIVES.get(name, Drive(name.removesuffix("_sync")))


def _drives(date: Path) -> list[Path]:
    return [folder for folder in subfolders(date) if folder.name.startswith(f"{date.name}_drive_")]


def _is_root(path: Path) -> bool:
    return any(_drives(date) for date in subfolders(path))
