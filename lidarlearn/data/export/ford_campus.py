"""Ford Campus's files."""

import numpy as np
import torch
from scipy.io import savemat

from lidarlearn.data.export.exporter import Exporter, timestamps_of
from lidarlearn.data.ford_campus import FordCampus
from lidarlearn.data.pose_files import euler_from_transforms
from lidarlearn.data.sequence import Sequence


class FordCampusExporter(Exporter[FordCampus]):
    """Writes MATLAB files with points, pose and time. Points closer than `min_range_m` are not read back."""

    option = "ford_campus"

    def require(self, drive: Sequence, name: str) -> None:
        """Scans are compensated and have poses."""
        self.require_compensated(drive)
        self.ground_truth(drive)

    def write(self, drive: Sequence, name: str) -> None:
        """Write a file per scan."""
        folder = self.target.root / name / "SCANS"
        folder.mkdir(parents=True, exist_ok=True)
        T_world_vehicle = self.ground_truth(drive) @ torch.linalg.inv(self.target.T_vehicle_lidar)
        poses = np.concatenate([T_world_vehicle[:, :3, 3].numpy(), euler_from_transforms(T_world_vehicle)], axis=1)
        utimes = np.round(timestamps_of(drive).numpy() * 1e6)
        for index, scan in enumerate(self.scans(drive, name)):
            x, y, z = scan.points.numpy().astype(np.float64).T
            content = {
                "XYZ": np.stack([-y, x, z]),
                "X_wv": poses[index][:, None],
                "timestamp_laser": np.array([[utimes[index]]]),
                "image_index": np.array([[index + 1]]),
            }
            savemat(folder / f"Scan{index + 1:04d}.mat", {"SCAN": content}, do_compression=True)
