"""NCLT: a Segway on the University of Michigan's North Campus, 27 drives in all seasons, with an HDL-32.

On disk: `DATE/velodyne_sync/<utime>.bin` and `groundtruth_DATE.csv`, either inside DATE or in `ground_truth` beside the
dates. A scan's name is its time [us]. A point takes 8 bytes: x, y, z as *unsigned* 16 bit (value * 0.005 - 100 m; read
as signed, everything beyond +63.84 m wraps), intensity and laser as 8 bit. Scans are motion compensated.

The files' frame is the Segway's: x forward, y right, z down, its origin `sensor_height_m` below the laser, which hangs
upside down and so sees from -10.67 to +30.67 deg. We move scans into the laser's own centre, x forward, y left, z up,
as a spherical projection needs: only there every beam has the constant elevation of the data sheet.
Ground truth is the Segway's pose at about 100 Hz: utime, x, y, z, roll, pitch, heading; rows with NaN stand for no fix.
"""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from lidarlearn.data.beam_correction import raise_beams
from lidarlearn.data.errors import DamagedFileError
from lidarlearn.data.interpolation import covered
from lidarlearn.data.layout import LayoutReport
from lidarlearn.data.on_disk import DataSetOnDisk, SequenceOnDisk
from lidarlearn.data.pose_files import StampedPoses, read_numbers, transforms_from_euler
from lidarlearn.data.scan_files import ScanFiles, is_folder, list_scans, read_bytes, subfolders
from lidarlearn.data.sequence import Names, Scan
from lidarlearn.geometry.projection import SphericalProjection

POINT = np.dtype([("xyz", "<u2", 3), ("intensity", "u1"), ("laser", "u1")])
SCALE_M = 0.005
OFFSET_M = -100.0
# From the files' axes (x forward, y right, z down) to ours (x forward, y left, z up).
FLIP = torch.diag(torch.tensor([1.0, -1.0, -1.0, 1.0], dtype=torch.float64))


@dataclass(frozen=True, eq=False, kw_only=True)
class NcltSequence(SequenceOnDisk):
    """A drive of NCLT.

    Args:
        name: its date.
        scans: its files.
        T_world_lidar: ground truth at the times of the scans; None if there is none.
        timestamps: from the files' names [s].
        beam_correction_deg: angle by which every beam is raised.
        sensor_height_m: of the laser above the origin of the files' frame.
    """

    sensor_height_m: float

    def scan(self, index: int) -> Scan:
        """Read one scan, which is motion compensated and so has no times."""
        data = np.frombuffer(read_bytes(self.scans.path(index), POINT.itemsize), POINT)
        xyz = torch.from_numpy(data["xyz"].astype(np.float32)) * SCALE_M + OFFSET_M
        points = xyz * torch.tensor([1.0, -1.0, -1.0]) - torch.tensor([0.0, 0.0, self.sensor_height_m])
        points = raise_beams(points, self.beam_correction_deg)
        return Scan(points, intensities=torch.from_numpy(data["intensity"].astype(np.float32)) / 255)


class Nclt(DataSetOnDisk):
    """NCLT.

    Args:
        root: the folder that holds the dates.
        projection: the image of the HDL-32 upside down.
        train_sequences: dates, e.g. 2012-01-22.
        val_sequences: dates.
        test_sequences: dates.
        max_frames: keep only the first scans of each sequence; None keeps all.
        deskew: must be false, as the scans are compensated.
        beam_correction_deg: angle by which every beam is raised.
        sensor_height_m: of the laser above the origin of the files' frame.
    """

    title = "NCLT"
    source = "http://robots.engin.umich.edu/nclt/ (velodyne and ground truth of each date)"
    marker = "folder of a date with velodyne_sync in it"

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
        sensor_height_m: float | int = 1.03,
    ) -> None:
        super().__init__(
            root, projection, train_sequences, val_sequences, test_sequences, max_frames, deskew, beam_correction_deg
        )
        self.sensor_height_m = float(sensor_height_m)
        self.T_files_lidar = FLIP.clone()
        self.T_files_lidar[2, 3] = -self.sensor_height_m

    def sequence(self, name: str) -> NcltSequence:
        """Open a drive; scans before and after its ground truth are left out."""
        self.refuse_deskew()
        scans = self._scans(name)
        self.require_scans(name, scans, "*.bin")
        truth_file = self._truth_file(name)
        truth = read_ground_truth(truth_file) if truth_file.is_file() else None
        if truth is not None:
            scans = scans.select(covered(truth_file, name, _timestamps(scans), truth.timestamps))
        scans = scans.first(self.max_frames)
        timestamps = _timestamps(scans)
        return NcltSequence(
            name=name,
            scans=scans,
            T_world_lidar=None if truth is None else truth.of_lidar(self.T_files_lidar, timestamps),
            timestamps=timestamps,
            beam_correction_deg=self.beam_correction_deg,
            sensor_height_m=self.sensor_height_m,
        )

    @staticmethod
    def is_root(path: Path) -> bool:
        """Whether a folder holds dates with scans."""
        return any(is_folder(date / "velodyne_sync") for date in subfolders(path))

    def found(self) -> dict[str, ScanFiles]:
        """All dates."""
        return {folder.name: self._scans(folder.name) for folder in subfolders(self.root)}

    def check_sequence(self, report: LayoutReport, name: str) -> None:
        """Scans and ground truth."""
        if not is_folder(self.root / name):
            report.missing(name, f"no folder {name}")
            return
        scans = self._scans(name)
        report.describe_scans(name, scans, POINT.itemsize)
        report.describe_ground_truth(name, self._truth_file(name), needed=name in self.test_sequences)

    def _scans(self, name: str) -> ScanFiles:
        return list_scans(self.root / name / "velodyne_sync", (".bin",), r"\d+", "1326030975726043.bin")

    def _truth_file(self, name: str) -> Path:
        inside, beside = (self.root / folder / f"groundtruth_{name}.csv" for folder in (name, "ground_truth"))
        return beside if beside.is_file() and not inside.is_file() else inside


def read_ground_truth(path: Path) -> StampedPoses:
    """Read the Segway's poses, z down; rows with NaN are dropped.

    A row is `utime, x, y, z, roll, pitch, heading` [us, m, rad].

    Raises:
        DamagedFileError: not such a file, fewer than two usable rows, or times that do not ascend.
    """
    rows = read_numbers(path, columns=7, delimiter=",")
    rows = rows[np.isfinite(rows).all(axis=1)]
    if len(rows) < 2:
        raise DamagedFileError(path, f"{len(rows)} rows without NaN")
    if (np.diff(rows[:, 0]) <= 0).any():
        raise DamagedFileError(path, "time stamps that do not ascend")
    return StampedPoses(torch.from_numpy(rows[:, 0] * 1e-6), transforms_from_euler(rows[:, 1:4], rows[:, 4:]))


def _timestamps(scans: ScanFiles) -> Float[Tensor, "n"]:
    return torch.tensor(scans.numbers, dtype=torch.float64) * 1e-6
