"""KITTI-360: nine drives through Karlsruhe's suburbs with an HDL-64, not motion compensated.

On disk: `data_3d_raw/2013_05_28_drive_NNNN_sync/velodyne_points/{data/%010d.bin, timestamps.txt}`,
`data_poses/2013_05_28_drive_NNNN_sync/poses.txt` and `calibration/{calib_cam_to_pose.txt, calib_cam_to_velo.txt}`.
Scans are float32 x, y, z, reflectance in the LiDAR's frame. A row of poses.txt is the number of a scan and the 3x4
pose of the GPS/IMU when the laser faced forward; scans without one (the car stood still) have theirs interpolated in
time. The laser turns as in KITTI raw, and point times follow likewise.
"""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from lidarlearn.data.errors import DamagedFileError
from lidarlearn.data.interpolation import covered
from lidarlearn.data.kitti_raw import KittiRawSequence
from lidarlearn.data.layout import LayoutReport
from lidarlearn.data.on_disk import DataSetOnDisk
from lidarlearn.data.oxts import read_timestamps
from lidarlearn.data.pose_files import (
    StampedPoses,
    as_transforms,
    read_labelled_transform,
    read_numbers,
    require_finite,
)
from lidarlearn.data.scan_files import ScanFiles, is_folder, list_scans, subfolders

_PREFIX, _SUFFIX = "2013_05_28_drive_", "_sync"


@dataclass(frozen=True, eq=False, kw_only=True)
class Kitti360Sequence(KittiRawSequence):
    """A drive of KITTI-360.

    Args:
        name: four digits.
        scans: its files.
        T_world_lidar: from GPS, IMU and registration; None if there are no poses.
        timestamps: when the laser faced forward [s], of the day's clock.
        beam_correction_deg: angle by which every beam is raised.
    """


class Kitti360(DataSetOnDisk):
    """KITTI-360.

    Args:
        root: the folder that holds data_3d_raw, data_poses and calibration.
        projection: the image of the HDL-64.
        train_sequences: four digits each, e.g. 0003.
        val_sequences: likewise.
        test_sequences: likewise.
        max_frames: keep only the first scans of each sequence; None keeps all.
        deskew: whether odometries compensate the motion within a scan.
        beam_correction_deg: angle by which every beam is raised.
    """

    title = "KITTI-360"
    digits = 4
    source = "https://www.cvlibs.net/datasets/kitti-360/ (raw Velodyne scans, calibrations, vehicle poses)"
    marker = "folder data_3d_raw with drives"

    def sequence(self, name: str) -> Kitti360Sequence:
        """Open a drive; scans before its first and after its last pose are left out."""
        scans = self._scans(name)
        self.require_scans(name, scans, "*.bin")
        stamps = self.require_file(name, scans.folder.parent / "timestamps.txt")
        truth = self._poses(name, stamps)
        if truth is not None:
            scan_times = read_timestamps(stamps, scans.numbers)
            scans = scans.select(covered(self._poses_file(name), name, scan_times, truth.timestamps))
        scans = scans.first(self.max_frames)
        timestamps = read_timestamps(stamps, scans.numbers)
        return Kitti360Sequence(
            name=name,
            scans=scans,
            T_world_lidar=None if truth is None else truth.of_lidar(self._calibration(name), timestamps),
            timestamps=timestamps,
            beam_correction_deg=self.beam_correction_deg,
        )

    @staticmethod
    def is_root(path: Path) -> bool:
        """Whether a folder holds `data_3d_raw`."""
        return is_folder(path / "data_3d_raw")

    def found(self) -> dict[str, ScanFiles]:
        """All drives."""
        drives = [folder.name for folder in subfolders(self.root / "data_3d_raw")]
        names = [name.removeprefix(_PREFIX).removesuffix(_SUFFIX) for name in drives if name.startswith(_PREFIX)]
        return {name: self._scans(name) for name in names}

    def check_sequence(self, report: LayoutReport, name: str) -> None:
        """Scans, their times and poses; the calibration is checked when the drive is opened."""
        folder = self.root / "data_3d_raw" / drive_folder(name)
        if not is_folder(folder):
            report.missing(name, f"no folder {folder.relative_to(self.root)}")
            return
        scans = self._scans(name)
        report.describe_scans(name, scans, bytes_per_point=16)
        rows_needed = max(scans.numbers, default=-1) + 1
        stamps = folder / "velodyne_points" / "timestamps.txt"
        report.describe_rows(name, stamps, "times", rows_needed, needed=True)
        report.describe_ground_truth(name, self._poses_file(name), needed=name in self.test_sequences)

    def _scans(self, name: str) -> ScanFiles:
        folder = self.root / "data_3d_raw" / drive_folder(name) / "velodyne_points" / "data"
        return list_scans(folder, (".bin",), r"\d{10}", "0000000000.bin")

    def _poses_file(self, name: str) -> Path:
        return self.root / "data_poses" / drive_folder(name) / "poses.txt"

    def _poses(self, name: str, stamps: Path) -> StampedPoses | None:
        """Poses of the GPS/IMU with the times of the scans that they belong to."""
        path = self._poses_file(name)
        if not path.is_file():
            return None
        rows = read_numbers(path, columns=13)
        require_finite(path, rows)
        if (np.diff(rows[:, 0]) <= 0).any():
            raise DamagedFileError(path, "scan numbers that do not ascend")
        times = read_timestamps(stamps, rows[:, 0].astype(int).tolist())
        return StampedPoses(times, as_transforms(torch.from_numpy(rows[:, 1:]).reshape(-1, 3, 4)))

    def _calibration(self, name: str) -> Float[Tensor, "4 4"]:
        """T_imu_lidar."""
        files = ("calib_cam_to_pose.txt", "calib_cam_to_velo.txt")
        paths = [self.require_file(name, self.root / "calibration" / file) for file in files]
        T_imu_camera = read_labelled_transform(paths[0], "image_00:")
        T_lidar_camera = read_labelled_transform(paths[1], "")
        return T_imu_camera @ torch.linalg.inv(T_lidar_camera)


def drive_folder(name: str) -> str:
    """Folder of a drive: 0003 becomes 2013_05_28_drive_0003_sync."""
    return f"{_PREFIX}{name}{_SUFFIX}"
