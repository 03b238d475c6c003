"""KITTI raw: drives with an HDL-64 and an RTK GPS/IMU, not motion compensated.

On disk: `DATE/DATE_drive_NNNN_sync/{velodyne_points/{data/%010d.bin, timestamps_start.txt, timestamps_end.txt},
oxts/{data/%010d.txt, timestamps.txt}}` and `DATE/calib_imu_to_velo.txt`.

The laser turns clockwise seen from above, from the rear over the left side: a point's time follows from its azimuth.
A scan's pose is that of the middle of its sweep, when the laser faces forward: GPS/IMU poses are interpolated there (a
packet is 12 to 22 ms off; without interpolation the disagreement with registered scans doubles). Where the recording
dropped scans, the others keep their numbers, and the time stamps have blank lines. Scans more than 0.1 s before the
first packet or after the last one are left out, as their poses are unknown.
"""

import math
from dataclasses import dataclass
from pathlib import Path

import torch
from jaxtyping import Float
from torch import Tensor

from lidarlearn.data.beam_correction import raise_beams
from lidarlearn.data.errors import DamagedFileError
from lidarlearn.data.interpolation import covered, interpolate_poses
from lidarlearn.data.layout import LayoutReport
from lidarlearn.data.on_disk import DataSetOnDisk, SequenceOnDisk
from lidarlearn.data.oxts import read_oxts_poses, read_rigid_transform, read_timestamps
from lidarlearn.data.pose_files import start_at_identity
from lidarlearn.data.scan_files import (
    ScanFiles,
    is_folder,
    list_scans,
    read_float32_rows,
    subfolders,
    warn_of_gaps,
)
from lidarlearn.data.sequence import Scan


@dataclass(frozen=True)
class Drive:
    """A drive of KITTI raw, or the part of it that is a sequence of KITTI odometry.

    Args:
        name: e.g. 2011_09_26_drive_0009.
        first: number of the first scan.
        last: number of the last scan, infinity for all.
    """

    name: str
    first: int = 0
    last: float | int = math.inf


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

_SLACK_S = 0.1  # a scan may be this long before the first or after the last GPS/IMU packet


@dataclass(frozen=True, eq=False, kw_only=True)
class KittiRawSequence(SequenceOnDisk):
    """A drive of KITTI raw.

    Args:
        name: of the drive, or two digits for the part of it that KITTI odometry holds.
        scans: its files.
        T_world_lidar: from GPS and IMU; None without their packets.
        timestamps: middle of each sweep [s], of the day's clock.
        beam_correction_deg: angle by which every beam is raised.
    """

    def scan(self, index: int) -> Scan:
        """Read one scan, with point times relative to the middle of the sweep."""
        rows = read_float32_rows(self.scans.path(index), columns=4)
        points = raise_beams(rows[:, :3], self.beam_correction_deg)
        return Scan(points, times=sweep_times(points), intensities=rows[:, 3].clamp(0, 1))


class KittiRaw(DataSetOnDisk):
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
    digits = 2
    source = "https://www.cvlibs.net/datasets/kitti/raw_data.php ([synced+rectified data] and [calibration] of a drive)"
    marker = "folder of a date with drives, like 2011_09_26"

    def sequence(self, name: str) -> KittiRawSequence:
        """Open a drive, or the part of one that is a sequence of KITTI odometry."""
        return self._open(name, self.max_frames)

    def open_for_check(self, name: str) -> KittiRawSequence:
        """Open the first scan of a drive: a long drive has thousands of GPS/IMU packets, a file each."""
        return self._open(name, 1)

    def _open(self, name: str, count: int | None) -> KittiRawSequence:
        """Open the first `count` scans of a drive that its packets cover; None opens all."""
        folder = self._folder(name)
        scans = self._scans(name)
        self.require_scans(name, scans, "*.bin")
        packets = _packets(folder)
        packet_times = self._packet_times(name, packets) if len(packets) else None
        if packet_times is not None:
            times_file = folder / "oxts" / "timestamps.txt"
            scans = scans.select(covered(times_file, name, self._timestamps(name, scans), packet_times, _SLACK_S))
        scans = scans.first(count)
        warn_of_gaps(name, scans)
        timestamps = self._timestamps(name, scans)
        return KittiRawSequence(
            name=name,
            scans=scans,
            T_world_lidar=None if packet_times is None else self._poses(name, packets, packet_times, timestamps),
            timestamps=timestamps,
            beam_correction_deg=self.beam_correction_deg,
        )

    @staticmethod
    def is_root(path: Path) -> bool:
        """Whether a folder holds dates with drives."""
        return any(_drives(date) for date in subfolders(path))

    def found(self) -> dict[str, ScanFiles]:
        """All drives; those configured as a sequence of KITTI odometry under its number."""
        configured = {_drive(name).name: name for name in self.names}
        drives = [drive.name.removesuffix("_sync") for date in subfolders(self.root) for drive in _drives(date)]
        names = [configured.get(drive, drive) for drive in drives]
        return {name: self._scans(name) for name in names}

    def check_sequence(self, report: LayoutReport, name: str) -> None:
        """Scans, their times, GPS/IMU packets and their calibration."""
        folder = self._folder(name)
        if not is_folder(folder):
            report.missing(name, f"no folder {folder.relative_to(self.root)}")
            return
        scans = self._scans(name)
        report.describe_scans(name, scans, bytes_per_point=16)
        rows_needed = max(scans.numbers, default=-1) + 1
        for end in ("start", "end"):
            stamps = folder / "velodyne_points" / f"timestamps_{end}.txt"
            report.describe_rows(name, stamps, f"{end} times", rows_needed, needed=True)
        packets = _packets(folder).numbers
        if not packets:
            detail = f"no ground truth: no files in {folder / 'oxts' / 'data'}"
            report.absent(name, detail, needed=name in self.test_sequences)
            return
        if len(packets) < rows_needed:
            report.odd(name, f"{len(packets)} GPS/IMU packets for scans numbered up to {rows_needed - 1}")
        stamps = folder / "oxts" / "timestamps.txt"
        report.describe_rows(name, stamps, "GPS/IMU times", max(packets) + 1, needed=True)
        if not (folder.parent / "calib_imu_to_velo.txt").is_file():
            report.missing(name, f"no calibration {folder.parent.name}/calib_imu_to_velo.txt")

    def _folder(self, name: str) -> Path:
        drive = _drive(name).name
        return self.root / drive.partition("_drive_")[0] / f"{drive}_sync"

    def _scans(self, name: str) -> ScanFiles:
        drive = _drive(name)
        scans = list_scans(self._folder(name) / "velodyne_points" / "data", (".bin",), r"\d{10}", "0000000000.bin")
        return scans.select(i for i, number in enumerate(scans.numbers) if drive.first <= number <= drive.last)

    def _timestamps(self, name: str, scans: ScanFiles) -> Float[Tensor, "n"]:
        files = (scans.folder.parent / f"timestamps_{end}.txt" for end in ("start", "end"))
        paths = [self.require_file(name, file) for file in files]
        start, end = (read_timestamps(path, scans.numbers) for path in paths)
        return (start + end) / 2

    def _packet_times(self, name: str, packets: ScanFiles) -> Float[Tensor, "n"]:
        path = self.require_file(name, self._folder(name) / "oxts" / "timestamps.txt")
        times = read_timestamps(path, packets.numbers)
        if (times.diff() <= 0).any():
            raise DamagedFileError(path, "times that do not ascend")
        return times

    def _poses(
        self, name: str, packets: ScanFiles, packet_times: Float[Tensor, "n"], timestamps: Float[Tensor, "m"]
    ) -> Float[Tensor, "m 4 4"]:
        T_lidar_imu = read_rigid_transform(self.require_file(name, self._folder(name).parent / "calib_imu_to_velo.txt"))
        # Only the packets that the scans need: a drive has thousands, one file each.
        first = max(int((packet_times <= timestamps.min()).sum()) - 1, 0)
        end = int((packet_times < timestamps.max()).sum()) + 1
        used = range(len(packets))[min(first, len(packets) - 2) : max(first + 2, end)]
        T_world_lidar = read_oxts_poses(packets.select(used)) @ torch.linalg.inv(T_lidar_imu)
        return start_at_identity(interpolate_poses(packet_times[list(used)], T_world_lidar, timestamps))


def sweep_times(points: Float[Tensor, "n 3"]) -> Float[Tensor, "n"]:
    """Time of each point as a share of the sweep, from -0.5 (at the rear, about to go left) over 0 (forward) to 0.5."""
    return -torch.atan2(points[:, 1], points[:, 0]) / (2 * math.pi)


def _drive(name: str) -> Drive:
    return ODOMETRY_DRIVES.get(name, Drive(name.removesuffix("_sync")))


def _drives(date: Path) -> list[Path]:
    return [folder for folder in subfolders(date) if folder.name.startswith(f"{date.name}_drive_")]


def _packets(folder: Path) -> ScanFiles:
    return list_scans(folder / "oxts" / "data", (".txt",), r"\d{10}")
