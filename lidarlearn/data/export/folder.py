"""A plain folder of scans."""

from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from pypcd4 import PointCloud

from lidarlearn.data.export.exporter import PERIOD_S, Exporter, timestamps_of
from lidarlearn.data.folder import Folder
from lidarlearn.data.ply import write_ply
from lidarlearn.data.pose_files import write_kitti_poses, write_times
from lidarlearn.data.sequence import Scan, Sequence
from lidarlearn.errors import UserError


class FolderExporter(Exporter[Folder]):
    """Writes scans, times.txt and, if the drive has ground truth, poses.txt with the LiDAR's own poses.

    .pcd and .ply hold intensities and point times [s from the first point on] if the drive has them, .bin and .npy
    x, y, z, intensity.

    Args:
        target: the folder of folders.
        suffix: of the scans: .bin, .npy, .pcd or .ply.
    """

    option = "folder"
    places = ("{}", "{}.txt", "{}.tum")

    def __init__(self, target: Folder, suffix: str = ".pcd") -> None:
        super().__init__(target)
        self.suffix = suffix

    def require(self, drive: Sequence, name: str) -> None:
        """Point times need files that hold them."""
        if self.suffix in (".bin", ".npy") and drive.first_returns().times is not None:
            raise UserError(
                f"suffix={self.suffix}: such files hold no point times, but the scans of {drive.name} have some."
                "\n  change: suffix=.pcd or suffix=.ply"
            )

    def write(self, drive: Sequence, name: str) -> None:
        """Write scans, times and poses."""
        folder = self.target.root / name
        folder.mkdir(parents=True, exist_ok=True)
        timestamps = timestamps_of(drive)
        period_s = float(timestamps.diff().median()) if len(drive) > 1 else PERIOD_S
        for index, scan in enumerate(self.scans(drive, name)):
            _write(folder / f"{index:06d}{self.suffix}", self._fields(scan, period_s), self.target.bin_columns)
        write_times(folder / "times.txt", timestamps)
        if drive.T_world_lidar is not None:
            write_kitti_poses(folder / "poses.txt", drive.T_world_lidar)

    def _fields(self, scan: Scan, period_s: float) -> dict[str, NDArray[np.float32]]:
        """What is known of each point, by the name of its field."""
        fields: dict[str, NDArray[np.float32]] = dict(zip("xyz", scan.points.numpy().T, strict=True))
        if scan.intensities is not None:
            fields["intensity"] = scan.intensities.numpy() * np.float32(self.target.max_intensity or 1.0)
        if scan.times is not None:
            fields["t"] = ((scan.times - scan.times.min()) * period_s).numpy()
        return fields


def _write(path: Path, fields: dict[str, NDArray[np.float32]], bin_columns: int) -> None:
    match path.suffix:
        case ".pcd":
            cloud = PointCloud.from_points(list(fields.values()), tuple(fields), (np.float32,) * len(fields))
            cloud.save(path)
        case ".ply":
            write_ply(path, fields)
        case ".bin":
            path.write_bytes(_rows(fields, bin_columns).tobytes())
        case _:
            np.save(path, _rows(fields, 4))


def _rows(fields: dict[str, NDArray[np.float32]], columns: int) -> NDArray[np.float32]:
    """x, y, z, intensity of each point; 0 where unknown and in further columns."""
    rows = np.zeros((len(fields["x"]), columns), dtype="<f4")
    for column, field in enumerate(("x", "y", "z", "intensity")):
        if field in fields:
            rows[:, column] = fields[field]
    return rows
