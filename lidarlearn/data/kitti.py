"""KITTI odometry: 22 drives with an HDL-64, motion compensated; ground truth for the first eleven.

On disk: `sequences/NN/{velodyne/%06d.bin, calib.txt, times.txt}` and `poses/NN.txt`. Scans are float32 x, y, z,
reflectance in the LiDAR's frame. Poses are those of the left camera; `Tr` in calib.txt is T_camera_lidar. A scan's
number selects its row of poses and times, so a copy may hold any part of the scans.
"""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from jaxtyping import Float
from torch import Tensor

from lidarlearn.data.beam_correction import raise_beams
from lidarlearn.data.errors import DamagedFileError
from lidarlearn.data.layout import LayoutReport
from lidarlearn.data.on_disk import DataSetOnDisk, SequenceOnDisk
from lidarlearn.data.pose_files import read_kitti_poses, read_labelled_transform, read_times, start_at_identity
from lidarlearn.data.scan_files import (
    ScanFiles,
    is_folder,
    list_scans,
    read_float32_rows,
    subfolders,
    warn_of_gaps,
)
from lidarlearn.data.sequence import Scan

_WITH_GROUND_TRUTH = tuple(f"{i:02d}" for i in range(11))


@dataclass(frozen=True, eq=False, kw_only=True)
class KittiOdometrySequence(SequenceOnDisk):
    """A drive of KITTI odometry.

    Args:
        name: two digits.
        scans: its files.
        T_world_lidar: ground truth, None from 11 on.
        timestamps: from times.txt [s].
        T_reference_lidar: `Tr`, to the left camera.
        beam_correction_deg: angle by which every beam is raised.
    """

    T_reference_lidar: Float[Tensor, "4 4"]
    reference_frame: str = "camera"

    def scan(self, index: int) -> Scan:
        """Read one scan, which is motion compensated and so has no times."""
        rows = read_float32_rows(self.scans.path(index), columns=4)
        return Scan(raise_beams(rows[:, :3], self.beam_correction_deg), intensities=rows[:, 3].clamp(0, 1))


class KittiOdometry(DataSetOnDisk):
    """KITTI odometry.

    Args:
        root: the folder that holds `sequences` and `poses`.
        projection: the image of the HDL-64.
        train_sequences: two digits each.
        val_sequences: two digits each.
        test_sequences: two digits each.
        max_frames: keep only the first scans of each sequence; None keeps all.
        deskew: must be false, as the scans are compensated.
        beam_correction_deg: angle by which every beam is raised, 0 for scans as published.
    """

    title = "KITTI odometry"
    digits = 2
    source = "https://www.cvlibs.net/datasets/kitti/eval_odometry.php (velodyne, calibration, ground truth poses)"
    marker = "folder 'sequences'"

    def sequence(self, name: str) -> KittiOdometrySequence:
        """Open a sequence."""
        self.refuse_deskew()
        folder = self.root / "sequences" / name
        scans = self._scans(name).first(self.max_frames)
        self.require_scans(name, scans, "*.bin")
        calibration = self.require_file(name, folder / "calib.txt")
        warn_of_gaps(name, scans)
        T_camera_lidar = read_labelled_transform(calibration, "Tr:")
        T_world_camera = _rows_of(scans, self.root / "poses" / f"{name}.txt", read_kitti_poses)
        return KittiOdometrySequence(
            name=name,
            scans=scans,
            T_world_lidar=None if T_world_camera is None else start_at_identity(T_world_camera @ T_camera_lidar),
            timestamps=_rows_of(scans, folder / "times.txt", read_times),
            T_reference_lidar=T_camera_lidar,
            beam_correction_deg=self.beam_correction_deg,
        )

    @staticmethod
    def is_root(path: Path) -> bool:
        """Whether a folder holds `sequences`."""
        return is_folder(path / "sequences")

    def found(self) -> dict[str, ScanFiles]:
        """All folders of `sequences`."""
        return {folder.name: self._scans(folder.name) for folder in subfolders(self.root / "sequences")}

    def check_sequence(self, report: LayoutReport, name: str) -> None:
        """Scans, calibration, times and poses."""
        folder = self.root / "sequences" / name
        if not is_folder(folder):
            report.missing(name, f"no folder sequences/{name}")
            return
        scans = self._scans(name)
        report.describe_scans(name, scans, bytes_per_point=16)
        if not (folder / "calib.txt").is_file():
            report.missing(name, "no calib.txt")
        rows_needed = max(scans.numbers, default=-1) + 1
        report.describe_rows(name, folder / "times.txt", "times", rows_needed)
        if name in _WITH_GROUND_TRUTH:
            poses = self.root / "poses" / f"{name}.txt"
            report.describe_rows(name, poses, "poses", rows_needed, needed=name in self.test_sequences)

    def _scans(self, name: str) -> ScanFiles:
        return list_scans(self.root / "sequences" / name / "velodyne", (".bin",), r"\d{6}", "000000.bin")


def _rows_of(scans: ScanFiles, path: Path, read: Callable[[Path], Tensor]) -> Tensor | None:
    """The row of each scan in a file of poses or times; None if there is no such file."""
    if not path.is_file():
        return None
    rows = read(path)
    if len(rows) <= scans.numbers[-1]:
        raise DamagedFileError(path, f"{len(rows)} rows, too few for scan {scans.names[-1]} in {scans.folder}")
    return rows[scans.numbers]
