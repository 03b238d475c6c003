"""KITTI odometry's files."""

from collections.abc import Iterable
from pathlib import Path

import numpy as np
import torch

from lidarlearn.data.export.exporter import Exporter, timestamps_of
from lidarlearn.data.kitti import KittiOdometry
from lidarlearn.data.pose_files import kitti_row, write_kitti_poses, write_times
from lidarlearn.data.sequence import Scan, Sequence
from lidarlearn.geometry import se3

# Axes of the left camera (x right, y down, z forward), for a drive without a camera of its own.
_T_CAMERA_LIDAR = torch.tensor(
    [[0.0, -1, 0, 0], [0, 0, -1, -0.08], [1, 0, 0, -0.27], [0, 0, 0, 1]], dtype=torch.float64
)


class KittiOdometryExporter(Exporter[KittiOdometry]):
    """Writes scans, calib.txt, times.txt and, if the drive has ground truth, the left camera's poses."""

    option = "kitti_00-08"
    places = ("sequences/{}", "poses/{}.txt")

    def require(self, drive: Sequence, name: str) -> None:
        """Scans are compensated."""
        self.require_compensated(drive)

    def write(self, drive: Sequence, name: str) -> None:
        """Write scans, calibration, times and poses."""
        folder = self.target.root / "sequences" / name
        write_velodyne_scans(folder / "velodyne", self.scans(drive, name), digits=6)
        T_camera_lidar = drive.T_reference_lidar if drive.reference_frame == "camera" else _T_CAMERA_LIDAR
        rows = {f"P{camera}": se3.identity() for camera in range(4)} | {"Tr": T_camera_lidar}
        calibration = "".join(f"{label}: {kitti_row(T)}\n" for label, T in rows.items())
        (folder / "calib.txt").write_text(calibration, encoding="utf-8")
        write_times(folder / "times.txt", timestamps_of(drive))
        if drive.T_world_lidar is not None:
            T_world_camera = T_camera_lidar @ drive.T_world_lidar @ torch.linalg.inv(T_camera_lidar)
            write_kitti_poses(self.target.root / "poses" / f"{name}.txt", T_world_camera)


def write_velodyne_scans(folder: Path, scans: Iterable[Scan], digits: int) -> None:
    """Write a file per scan of float32 x, y, z, reflectance (0 if unknown).

    Args:
        folder: of the files; made where missing.
        scans: are numbered from 0.
        digits: of the number that is a file's name.
    """
    folder.mkdir(parents=True, exist_ok=True)
    for index, scan in enumerate(scans):
        rows = np.zeros((len(scan.points), 4), dtype="<f4")
        rows[:, :3] = scan.points.numpy()
        if scan.intensities is not None:
            rows[:, 3] = scan.intensities.numpy()
        (folder / f"{index:0{digits}d}.bin").write_bytes(rows.tobytes())
