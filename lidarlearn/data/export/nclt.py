"""NCLT's files."""

from datetime import datetime, timezone

import numpy as np
import torch

from lidarlearn.data.export.exporter import Exporter, timestamps_of
from lidarlearn.data.nclt import FLIP, OFFSET_M, POINT, SCALE_M, Nclt
from lidarlearn.data.pose_files import euler_from_transforms
from lidarlearn.data.sequence import Scan, Sequence
from lidarlearn.errors import UserError

_LASERS = 32
_LOWEST_DEG, _HIGHEST_DEG = -10.67, 30.67  # of the HDL-32 upside down


class NcltExporter(Exporter[Nclt]):
    """Writes scans in steps of 5 mm and, if the drive has ground truth, a row of it at the time of each scan.

    A point's laser follows from its elevation. Points that the format cannot hold, farther than 100 m behind or to the
    right, are left out.
    """

    option = "nclt"
    places = ("{}", "ground_truth/groundtruth_{}.csv")

    def require(self, drive: Sequence, name: str) -> None:
        """Scans are compensated, and the name is a date."""
        self.require_compensated(drive)
        _noon(name)

    def write(self, drive: Sequence, name: str) -> None:
        """Write scans and ground truth."""
        folder = self.target.root / name
        (folder / "velodyne_sync").mkdir(parents=True, exist_ok=True)
        noon_us = int(_noon(name).timestamp()) * 1_000_000
        utimes = (noon_us + torch.round(timestamps_of(drive) * 1e6).long()).tolist()
        for utime, scan in zip(utimes, self.scans(drive, name), strict=True):
            (folder / "velodyne_sync" / f"{utime}.bin").write_bytes(self._content(scan))
        if drive.T_world_lidar is not None:
            T_world_files = FLIP @ drive.T_world_lidar @ torch.linalg.inv(self.target.T_files_lidar)
            numbers = np.concatenate([T_world_files[:, :3, 3].numpy(), euler_from_transforms(T_world_files)], axis=1)
            text = "".join(
                f"{utime}, {', '.join(f'{value:.12g}' for value in row)}\n"
                for utime, row in zip(utimes, numbers, strict=True)
            )
            (folder / f"groundtruth_{name}.csv").write_text(text, encoding="utf-8")

    def _content(self, scan: Scan) -> bytes:
        """The file of a scan, with the points that the format can hold."""
        elevations = torch.rad2deg(torch.atan2(scan.points[:, 2], scan.points[:, :2].norm(dim=1))).numpy()
        files_xyz = (scan.points.numpy() + np.array([0.0, 0.0, self.target.sensor_height_m])) * [1, -1, -1]
        steps = np.round((files_xyz - OFFSET_M) / SCALE_M)
        held = ((steps >= 0) & (steps <= np.iinfo(np.uint16).max)).all(axis=1)
        rows = np.zeros(int(held.sum()), dtype=POINT)
        rows["xyz"] = steps[held]
        share = (elevations[held] - _LOWEST_DEG) / (_HIGHEST_DEG - _LOWEST_DEG)
        rows["laser"] = np.clip(np.round(share * (_LASERS - 1)), 0, _LASERS - 1)
        if scan.intensities is not None:
            rows["intensity"] = np.round(scan.intensities.numpy()[held] * 255)
        return rows.tobytes()


def _noon(name: str) -> datetime:
    """Noon of the day that a sequence is named after."""
    try:
        return datetime.strptime(name, "%Y-%m-%d").replace(hour=12, tzinfo=timezone.utc)
    except ValueError as error:
        raise UserError(f"NCLT: {name!r} is not a date.\n  change: a name like 2012-01-08") from error
