"""A plain folder of scans."""

from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from pypcd4 import PointCloud

from lidarlearn.data.beam_correction import raise_beams
from lidarlearn.data.export.drives import period_of, scans_of, timestamps_of
from lidarlearn.data.export.kitti import matrix_row
from lidarlearn.data.folder import Folder
from lidarlearn.data.ply import write_ply
from lidarlearn.data.sequence import Sequence
from lidarlearn.errors import UserError


def require_folder(drive: Sequence, target: Folder, name: str, suffix: str = ".pcd") -> None:
    """Raise UserError where points have times, and files of the suffix hold none."""
    if suffix in (".bin", ".npy") and drive.first_returns().times is not None:
        raise UserError(
            f"suffix={suffix}: such files hold no point times, but the scans of {drive.name} have some."
            "\n  change: suffix=.pcd or suffix=.ply"
        )


def write_folder(drive: Sequence, target: Folder, name: str, suffix: str = ".pcd") -> None:
    """Scans, times.txt and, where the drive has ground truth, poses.txt with the LiDAR's own poses.

    .pcd and .ply hold intensities and point times [s from the first point on] where the drive has them, .bin and .npy
    x, y, z, intensity.

    Args:
        drive: what is written.
        target: the folder of folders.
        name: of the folder.
        suffix: .bin, .npy, .pcd or .ply.
    """
    folder = target.root / name
    folder.mkdir(parents=True, exist_ok=True)
    period_s = period_of(drive)
    for index, scan in enumerate(scans_of(drive, name)):
        x, y, z = raise_beams(scan.points, -target.beam_correction_deg).numpy().T
        fields: dict[str, NDArray[np.float32]] = {"x": x, "y": y, "z": z}
        if scan.intensities is not None:
            fields["intensity"] = scan.intensities.numpy() * np.float32(target.max_intensity or 1.0)
        if scan.times is not None:
            fields["t"] = ((scan.times - scan.times.min()) * period_s).numpy()
        _write(folder / f"{index:06d}{suffix}", fields, target.bin_columns)
    (folder / "times.txt").write_text(
        "".join(f"{time:.9f}\n" for time in timestamps_of(drive).tolist()), encoding="utf-8"
    )
    if drive.T_world_lidar is not None:
        (folder / "poses.txt").write_text("".join(f"{matrix_row(T)}\n" for T in drive.T_world_lidar), encoding="utf-8")


def _write(path: Path, fields: dict[str, NDArray[np.float32]], bin_columns: int) -> None:
    match path.suffix:
        case ".pcd":
            cloud = PointCloud.from_points(list(fields.values()), tuple(fields), (np.float32,) * len(fields))
            cloud.save(path)
        case ".ply":
            write_ply(path, fields)
        case _:
            rows = np.zeros((len(fields["x"]), bin_columns if path.suffix == ".bin" else 4), dtype="<f4")
            for column, field in enumerate(("x", "y", "z", "intensity")):
                if field in fields:
                    rows[:, column] = fields[field]
            if path.suffix == ".bin":
                path.write_bytes(rows.tobytes())
            else:
                np.save(path, rows)
