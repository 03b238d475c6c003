"""Ford Campus's files."""

import numpy as np
import torch
from scipy.io import savemat
from scipy.spatial.transform import Rotation

from lidarlearn.data.beam_correction import raise_beams
from lidarlearn.data.export.drives import ground_truth_of, require_compensated, scans_of, timestamps_of
from lidarlearn.data.ford_campus import FordCampus
from lidarlearn.data.sequence import Sequence


def require_ford_campus(drive: Sequence, target: FordCampus, name: str) -> None:
    """Raise UserError unless the scans are compensated and have poses."""
    require_compensated(drive, target.title)
    ground_truth_of(drive, target.title)


def write_ford_campus(drive: Sequence, target: FordCampus, name: str) -> None:
    """MATLAB files with points, pose and time. Points closer than `min_range_m` are written, but not read back."""
    T_world_vehicle = ground_truth_of(drive, target.title) @ torch.linalg.inv(target.T_vehicle_lidar)
    folder = target.root / name / "SCANS"
    folder.mkdir(parents=True, exist_ok=True)
    utimes = np.round(timestamps_of(drive).numpy() * 1e6)
    for index, scan in enumerate(scans_of(drive, name)):
        x, y, z = raise_beams(scan.points, -target.beam_correction_deg).numpy().astype(np.float64).T
        T = T_world_vehicle[index].numpy()
        angles = Rotation.from_matrix(T[:3, :3]).as_euler("ZYX")[::-1]
        content = {
            "XYZ": np.stack([-y, x, z]),
            "X_wv": np.concatenate([T[:3, 3], angles])[:, None],
            "timestamp_laser": np.array([[utimes[index]]]),
            "image_index": np.array([[index + 1]]),
        }
        savemat(folder / f"Scan{index + 1:04d}.mat", {"SCAN": content}, do_compression=True)
