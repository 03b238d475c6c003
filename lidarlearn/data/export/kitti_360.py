"""KITTI-360's files."""

import numpy as np
import torch

from lidarlearn.data.export.drives import ground_truth_of, require_sweeps, scans_of, timestamps_of, write_shared
from lidarlearn.data.export.kitti import matrix_row, write_velodyne_points
from lidarlearn.data.export.kitti_raw import write_timestamps
from lidarlearn.data.kitti_360 import Kitti360, drive_folder
from lidarlearn.data.sequence import Sequence

_DAY = np.datetime64("2013-05-28", "ns")

# Of the left camera (x right, y down, z forward) in the GPS/IMU (x forward, y right, z down), and in the LiDAR.
_T_IMU_CAMERA = torch.tensor([[0.0, 0, 1, 1.58], [1, 0, 0, -0.3], [0, 1, 0, -0.91], [0, 0, 0, 1]], dtype=torch.float64)
_T_LIDAR_CAMERA = torch.tensor(
    [[0.0, 0, 1, 0.8], [-1, 0, 0, 0.3], [0, -1, 0, -0.18], [0, 0, 0, 1]], dtype=torch.float64
)


def require_kitti_360(drive: Sequence, target: Kitti360, name: str) -> None:
    """Raise UserError unless azimuths tell the points' times, and there are poses."""
    require_sweeps(drive, target.title)
    ground_truth_of(drive, target.title)


def write_kitti_360(drive: Sequence, target: Kitti360, name: str) -> None:
    """Scans, their times, a pose for each, and the calibrations from LiDAR over camera to GPS/IMU."""
    T_world_lidar = ground_truth_of(drive, target.title)
    velodyne = target.root / "data_3d_raw" / drive_folder(name) / "velodyne_points"
    poses, calibration = target.root / "data_poses" / drive_folder(name), target.root / "calibration"
    write_shared(calibration / "calib_cam_to_pose.txt", f"image_00: {matrix_row(_T_IMU_CAMERA)}\n")
    write_shared(calibration / "calib_cam_to_velo.txt", f"{matrix_row(_T_LIDAR_CAMERA)}\n")
    for folder in (velodyne / "data", poses):
        folder.mkdir(parents=True, exist_ok=True)
    for index, scan in enumerate(scans_of(drive, name)):
        write_velodyne_points(velodyne / "data" / f"{index:010d}.bin", scan, target.beam_correction_deg)
    write_timestamps(velodyne / "timestamps.txt", _DAY, timestamps_of(drive))
    T_world_imu = T_world_lidar @ _T_LIDAR_CAMERA @ torch.linalg.inv(_T_IMU_CAMERA)
    rows = (f"{index} {matrix_row(T)}\n" for index, T in enumerate(T_world_imu))
    (poses / "poses.txt").write_text("".join(rows), encoding="utf-8")
