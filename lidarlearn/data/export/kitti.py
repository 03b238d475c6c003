"""KITTI odometry's files."""

from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from lidarlearn.data.beam_correction import raise_beams
from lidarlearn.data.export.drives import require_compensated, scans_of, timestamps_of
from lidarlearn.data.kitti import KittiOdometry
from lidarlearn.data.sequence import Scan, Sequence

# Axes of the left camera (x right, y down, z forward) for a drive that had none.
_T_CAMERA_LIDAR = torch.tensor(
    [[0.0, -1, 0, 0], [0, 0, -1, -0.08], [1, 0, 0, -0.27], [0, 0, 0, 1]], dtype=torch.float64
)


def require_kitti_odometry(drive: Sequence, target: KittiOdometry, name: str) -> None:
    """Raise UserError unless the scans are compensated."""
    require_compensated(drive, target.title)


def write_kitti_odometry(drive: Sequence, target: KittiOdometry, name: str) -> None:
    """Scans, calib.txt, times.txt and, where the drive has ground truth, poses."""
    folder = target.root / "sequences" / name
    (folder / "velodyne").mkdir(parents=True, exist_ok=True)
    for index, scan in enumerate(scans_of(drive, name)):
        write_velodyne_points(folder / "velodyne" / f"{index:06d}.bin", scan, target.beam_correction_deg)
    T_camera_lidar = drive.T_reference_lidar if drive.reference_frame == "camera" else _T_CAMERA_LIDAR
    pinhole = matrix_row(torch.eye(4, dtype=torch.float64))
    calibration = [*(f"P{camera}: {pinhole}" for camera in range(4)), f"Tr: {matrix_row(T_camera_lidar)}"]
    (folder / "calib.txt").write_text("\n".join(calibration) + "\n", encoding="utf-8")
    (folder / "times.txt").write_text(
        "".join(f"{time:.9f}\n" for time in timestamps_of(drive).tolist()), encoding="utf-8"
    )
    if drive.T_world_lidar is not None:
        T_world_camera = T_camera_lidar @ drive.T_world_lidar @ torch.linalg.inv(T_camera_lidar)
        (target.root / "poses").mkdir(exist_ok=True)
        rows = "".join(f"{matrix_row(T)}\n" for T in T_world_camera)
        (target.root / "poses" / f"{name}.txt").write_text(rows, encoding="utf-8")


def write_velodyne_points(path: Path, scan: Scan, beam_correction_deg: float) -> None:
    """float32 x, y, z, reflectance; 0 where it is unknown.

    Args:
        path: of the file.
        scan: what is written.
        beam_correction_deg: the beams are lowered by as much as a reader raises them.
    """
    rows = np.zeros((len(scan.points), 4), dtype="<f4")
    rows[:, :3] = raise_beams(scan.points, -beam_correction_deg).numpy()
    if scan.intensities is not None:
        rows[:, 3] = scan.intensities.numpy()
    path.write_bytes(rows.tobytes())


def matrix_row(T: Float[Tensor, "4 4"]) -> str:
    """The upper three rows of a transform as twelve numbers."""
    return " ".join(f"{value:.12e}" for value in T[:3].flatten().tolist())
