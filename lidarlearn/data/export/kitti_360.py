"""KITTI-360's files."""

import numpy as np
import torch

from lidarlearn.data.export.exporter import Exporter, timestamps_of, write_shared
from lidarlearn.data.export.kitti import write_velodyne_scans
from lidarlearn.data.kitti_360 import Kitti360, drive_folder
from lidarlearn.data.oxts import write_timestamps
from lidarlearn.data.pose_files import kitti_row
from lidarlearn.data.sequence import Sequence

_DAY = np.datetime64("2013-05-28", "ns")

# Of the left camera (x right, y down, z forward) in the GPS/IMU (x forward, y right, z down), and in the LiDAR.
_T_IMU_CAMERA = torch.tensor([[0.0, 0, 1, 1.58], [1, 0, 0, -0.3], [0, 1, 0, -0.91], [0, 0, 0, 1]], dtype=torch.float64)
_T_LIDAR_CAMERA = torch.tensor(
    [[0.0, 0, 1, 0.8], [-1, 0, 0, 0.3], [0, -1, 0, -0.18], [0, 0, 0, 1]], dtype=torch.float64
)


class Kitti360Exporter(Exporter[Kitti360]):
    """Writes scans, their times, a pose for each, and the calibrations from LiDAR over camera to GPS/IMU."""

    option = "kitti_360"
    places = ("data_*/*_drive_{}_sync",)

    def require(self, drive: Sequence, name: str) -> None:
        """Point times follow from azimuths, and scans have poses."""
        self.require_sweeps(drive)
        self.ground_truth(drive)

    def write(self, drive: Sequence, name: str) -> None:
        """Write calibrations, scans, times and poses."""
        calibration = self.target.root / "calibration"
        write_shared(calibration / "calib_cam_to_pose.txt", f"image_00: {kitti_row(_T_IMU_CAMERA)}\n")
        write_shared(calibration / "calib_cam_to_velo.txt", f"{kitti_row(_T_LIDAR_CAMERA)}\n")
        velodyne = self.target.root / "data_3d_raw" / drive_folder(name) / "velodyne_points"
        write_velodyne_scans(velodyne / "data", self.scans(drive, name), digits=10)
        write_timestamps(velodyne / "timestamps.txt", _DAY, timestamps_of(drive))
        T_world_imu = self.ground_truth(drive) @ _T_LIDAR_CAMERA @ torch.linalg.inv(_T_IMU_CAMERA)
        poses = self.target.root / "data_poses" / drive_folder(name)
        poses.mkdir(parents=True, exist_ok=True)
        rows = (f"{index} {kitti_row(T)}\n" for index, T in enumerate(T_world_imu))
        (poses / "poses.txt").write_text("".join(rows), encoding="utf-8")
