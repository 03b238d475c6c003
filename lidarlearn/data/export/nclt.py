"""NCLT's files."""

from datetime import datetime, timezone

import numpy as np
import torch
from scipy.spatial.transform import Rotation

from lidarlearn.data.beam_correction import raise_beams
from lidarlearn.data.export.drives import require_compensated, scans_of, timestamps_of
from lidarlearn.data.nclt import FLIP, OFFSET_M, POINT, SCALE_M, Nclt
from lidarlearn.data.sequence import Sequence
from lidarlearn.errors import UserError

_LASERS = 32
_LOWEST_DEG, _HIGHEST_DEG = -10.67, 30.67  # of the HDL-32 upside down


def require_nclt(drive: Sequence, target: Nclt, name: str) -> None:
    """Raise UserError unless the scans are compensated, and the name is a date."""
    require_compensated(drive, target.title)
    _noon(name)


def write_nclt(drive: Sequence, target: Nclt, name: str) -> None:
    """Scans in steps of 5 mm and, where the drive has ground truth, a row of it at the time of each scan.

    The laser of a point is told from its elevation. Points that the format cannot hold, farther than 100 m behind or
    to the right, are left out.
    """
    utimes = int(_noon(name).timestamp()) * 1_000_000 + torch.round(timestamps_of(drive) * 1e6).long()
    folder = target.root / name
    (folder / "velodyne_sync").mkdir(parents=True, exist_ok=True)
    for utime, scan in zip(utimes.tolist(), scans_of(drive, name), strict=True):
        points = raise_beams(scan.points, -target.beam_correction_deg)
        elevations = torch.rad2deg(torch.atan2(points[:, 2], points[:, :2].norm(dim=1))).numpy()
        files_xyz = (points.numpy() + np.array([0.0, 0.0, target.sensor_height_m])) * [1, -1, -1]
        steps = np.round((files_xyz - OFFSET_M) / SCALE_M)
        held = ((steps >= 0) & (steps <= np.iinfo(np.uint16).max)).all(axis=1)
        rows = np.zeros(int(held.sum()), dtype=POINT)
        rows["xyz"] = steps[held]
        share = (elevations[held] - _LOWEST_DEG) / (_HIGHEST_DEG - _LOWEST_DEG)
        rows["laser"] = np.clip(np.round(share * (_LASERS - 1)), 0, _LASERS - 1)
        if scan.intensities is not None:
            rows["intensity"] = np.round(scan.intensities.numpy()[held] * 255)
        (folder / "velodyne_sync" / f"{utime}.bin").write_bytes(rows.tobytes())
    if drive.T_world_lidar is not None:
        T_files_lidar = FLIP.clone()
        T_files_lidar[2, 3] = -target.sensor_height_m
        T = (FLIP @ drive.T_world_lidar @ torch.linalg.inv(T_files_lidar)).numpy()
        angles = Rotation.from_matrix(T[:, :3, :3]).as_euler("ZYX")[:, ::-1]
        numbers = np.concatenate([T[:, :3, 3], angles], axis=1).tolist()
        rows_text = (
            f"{t}, " + ", ".join(f"{v:.12g}" for v in row) for t, row in zip(utimes.tolist(), numbers, strict=True)
        )
        (folder / f"groundtruth_{name}.csv").write_text("\n".join(rows_text) + "\n", encoding="utf-8")


def _noon(name: str) -> datetime:
    """Of the day that a sequence is named after."""
    try:
        return datetime.strptime(name, "%Y-%m-%d").replace(hour=12, tzinfo=timezone.utc)
    except ValueError as error:
        raise UserError(f"NCLT: {name!r} is not a date.\n  change: a name like 2012-01-08") from error
