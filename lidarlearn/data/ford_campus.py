"""Ford Campus: two drives around Dearborn, Michigan, with an HDL-64 on the roof of a pickup truck.

On disk: `IJRR-Dataset-{1,2}/SCANS/Scan%04d.mat`, MATLAB files with a structure `SCAN`: `XYZ` (3 x n [m], the laser's
frame with y forward and x right), `X_wv` (x, y, z [m], roll, pitch, heading [rad]: pose of the vehicle in the world)
and `timestamp_laser` [us]. We turn points to x forward, y left: x' = y, y' = -x. Returns closer than 8 m are the truck
itself. Poses are inside the scan files: reading them takes minutes the first time, then they are kept beside the scans.

The vehicle's frame is taken to have the axes of the turned points, as in the implementation by the authors of
Dellenbach et al. 2021. `T_vehicle_lidar_m_deg` is for copies where this is wrong: the data set's PARAM.mat and paper
place the laser at (2.4, -0.01, -2.3) m, (180, 0, 90) deg in a vehicle frame whose z points down,
which for turned points reads [2.4, -0.01, -2.3, 180, 0, 0].
"""

import logging
import zipfile
import zlib
from collections.abc import Iterable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.io import loadmat
from scipy.io.matlab import MatReadError

from lidarlearn.data.beam_correction import raise_beams
from lidarlearn.data.errors import DamagedFileError
from lidarlearn.data.layout import LayoutReport
from lidarlearn.data.on_disk import DataSetOnDisk, SequenceOnDisk
from lidarlearn.data.pose_files import start_at_identity, transforms_from_euler
from lidarlearn.data.scan_files import ScanFiles, is_folder, list_scans, subfolders, warn_of_gaps
from lidarlearn.data.sequence import Names, Scan
from lidarlearn.geometry.projection import SphericalProjection
from lidarlearn.progress import tracked

_log = logging.getLogger(__name__)

_POSES_FILE = "lidarlearn_poses.npz"
_SMALLEST_BYTES = 1000  # of a file that holds a scan


@dataclass(frozen=True, eq=False, kw_only=True)
class FordCampusSequence(SequenceOnDisk):
    """A drive of Ford Campus.

    Args:
        name: its folder.
        scans: its files.
        T_world_lidar: ground truth.
        timestamps: of the scans [s].
        min_range_m: closer returns are left out.
        beam_correction_deg: angle by which every beam is raised.
    """

    min_range_m: float

    def scan(self, index: int) -> Scan:
        """Read one scan, without times as it is motion compensated, and without intensities as the files hold none."""
        path = self.scans.path(index)
        laser = torch.from_numpy(_field(path, read_scan(path), "XYZ", rows=3).astype(np.float32))
        points = torch.stack([laser[1], -laser[0], laser[2]], dim=1)
        if not len(points):
            raise DamagedFileError(path, "a scan without points")
        if not points.isfinite().all():
            raise DamagedFileError(path, "points that are not finite")
        points = points[points.norm(dim=1) >= self.min_range_m]
        return Scan(raise_beams(points, self.beam_correction_deg))


class FordCampus(DataSetOnDisk):
    """Ford Campus.

    Args:
        root: the folder that holds IJRR-Dataset-1 and IJRR-Dataset-2.
        projection: the image of the HDL-64.
        train_sequences: IJRR-Dataset-1 or IJRR-Dataset-2.
        val_sequences: likewise.
        test_sequences: likewise.
        max_frames: keep only the first scans of each sequence; None keeps all.
        deskew: must be false, as the scans are compensated.
        beam_correction_deg: angle by which every beam is raised.
        min_range_m: closer returns are the truck itself.
        T_vehicle_lidar_m_deg: pose of the (turned) laser in the vehicle: x, y, z [m], roll, pitch, yaw [deg].
    """

    title = "Ford Campus"
    source = "http://robots.engin.umich.edu/SoftwareData/Ford (dataset-1 and dataset-2)"
    marker = "folder like IJRR-Dataset-1 with SCANS in it"

    def __init__(
        self,
        root: str | Path,
        projection: SphericalProjection,
        train_sequences: Names,
        val_sequences: Names,
        test_sequences: Names,
        max_frames: int | None,
        deskew: bool,
        beam_correction_deg: float | int,
        min_range_m: float | int = 8.0,
        T_vehicle_lidar_m_deg: Iterable[float | int] = (0, 0, 0, 0, 0, 0),
    ) -> None:
        super().__init__(
            root, projection, train_sequences, val_sequences, test_sequences, max_frames, deskew, beam_correction_deg
        )
        self.min_range_m = float(min_range_m)
        x_y_z_m, roll_pitch_yaw_deg = np.array(list(T_vehicle_lidar_m_deg), dtype=np.float64).reshape(2, 1, 3)
        self.T_vehicle_lidar = transforms_from_euler(x_y_z_m, np.radians(roll_pitch_yaw_deg))[0]

    def sequence(self, name: str) -> FordCampusSequence:
        """Open a drive; the first time reads every scan for its pose."""
        return self._open(name, self.max_frames)

    def open_for_check(self, name: str) -> FordCampusSequence:
        """Open the first scan of a drive: reading all for their poses takes minutes."""
        return self._open(name, 1)

    def _open(self, name: str, count: int | None) -> FordCampusSequence:
        """Open the first `count` scans of a drive; None opens all."""
        self.refuse_deskew()
        scans = self._scans(name).first(count)
        self.require_scans(name, scans, "Scan*.mat")
        warn_of_gaps(name, scans)
        stamped = read_poses(name, scans)
        T_world_vehicle = transforms_from_euler(stamped[:, 1:4], stamped[:, 4:])
        return FordCampusSequence(
            name=name,
            scans=scans,
            T_world_lidar=start_at_identity(T_world_vehicle @ self.T_vehicle_lidar),
            timestamps=torch.from_numpy(stamped[:, 0] * 1e-6),
            min_range_m=self.min_range_m,
            beam_correction_deg=self.beam_correction_deg,
        )

    @staticmethod
    def is_root(path: Path) -> bool:
        """Whether a folder holds drives with scans."""
        return any(is_folder(folder / "SCANS") for folder in subfolders(path))

    def found(self) -> dict[str, ScanFiles]:
        """All drives."""
        return {folder.name: self._scans(folder.name) for folder in subfolders(self.root)}

    def check_sequence(self, report: LayoutReport, name: str) -> None:
        """Scans alone: they hold everything else."""
        if not is_folder(self.root / name):
            report.missing(name, f"no folder {name}")
            return
        scans = self._scans(name)
        report.describe_scans(name, scans, bytes_per_point=None, smallest_bytes=_SMALLEST_BYTES)

    def _scans(self, name: str) -> ScanFiles:
        return list_scans(self.root / name / "SCANS", (".mat",), r"Scan\d+", "Scan0001.mat")


def read_scan(path: Path) -> np.void:
    """Read the structure `SCAN` of a file.

    Raises:
        DamagedFileError: no MATLAB file, truncated, or without the structure.
    """
    try:
        return loadmat(path, variable_names=["SCAN"])["SCAN"][0, 0]
    except (OSError, MatReadError, ValueError, TypeError, zlib.error, KeyError, IndexError) as error:
        raise DamagedFileError(path, f"no MATLAB file with a structure SCAN ({error})") from error


def read_poses(name: str, scans: ScanFiles) -> NDArray[np.float64]:
    """Time [us], position [m], roll, pitch and heading [rad] of every scan (n, 7), kept in a file beside the scans.

    Those of a single scan are not kept: they would replace those of the whole drive.

    Raises:
        DamagedFileError: a scan cannot be read or its pose is not finite.
    """
    if len(scans) == 1:
        return _read_pose(scans.path(0))[None]
    kept = scans.folder.parent / _POSES_FILE
    key = scans.fingerprint("poses")
    if (stamped := _kept_poses(kept, key)) is not None:
        return stamped
    with ThreadPoolExecutor() as pool:  # decompression releases the interpreter's lock
        rows = pool.map(_read_pose, (scans.path(i) for i in range(len(scans))))
        stamped = np.stack(list(tracked(rows, f"reading the poses of {name}", len(scans))))
    try:
        np.savez(kept, key=key, stamped=stamped)
    except OSError as error:
        _log.info("poses are not kept for the next time: %s", error)
    return stamped


def _kept_poses(path: Path, key: str) -> NDArray[np.float64] | None:
    try:
        with np.load(path) as file:
            return file["stamped"] if str(file["key"]) == key else None
    except (OSError, ValueError, KeyError, EOFError, zipfile.BadZipFile):
        return None


def _read_pose(path: Path) -> NDArray[np.float64]:
    scan = read_scan(path)
    stamp = _field(path, scan, "timestamp_laser", rows=1).astype(np.float64)
    row = np.concatenate([stamp.reshape(1), _field(path, scan, "X_wv", rows=6).astype(np.float64).reshape(6)])
    if not np.isfinite(row).all():
        raise DamagedFileError(path, "a pose X_wv that is not finite")
    return row


def _field(path: Path, scan: np.void, name: str, rows: int) -> NDArray[Any]:
    """A field of `SCAN` of shape (rows, n)."""
    names = scan.dtype.names or ()
    if name not in names:
        raise DamagedFileError(path, f"SCAN has no field {name}, only {', '.join(names)}")
    values = scan[name]
    if values.ndim != 2 or values.shape[0] != rows:
        raise DamagedFileError(path, f"SCAN.{name} is {values.shape}, not ({rows}, n)")
    return values
