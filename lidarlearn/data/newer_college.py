"""Newer College (2020): walks through an Oxford college with a hand-held Ouster OS1-64, not motion compensated.

On disk: `NAME/raw_format/ouster_scan/cloud_<s>_<ns>.pcd` and `NAME/ground_truth/registered_poses.csv`. A scan's name is
the time of its first column. A .pcd holds 1024 columns of 64 points each, with the origin for no return, so a point's
place in the file gives its time. Poses (`sec,nsec,x,y,z,qx,qy,qz,qw`) are those of the left camera at about
10 Hz, from registration to a survey-grade map; we interpolate them at the middle of each sweep.
"""

from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float
from scipy.spatial.transform import Rotation
from torch import Tensor

from lidarlearn.data.beam_correction import raise_beams
from lidarlearn.data.cloud_files import note_returns, read_cloud
from lidarlearn.data.interpolation import covered
from lidarlearn.data.layout import LayoutReport
from lidarlearn.data.on_disk import DataSetOnDisk, SequenceOnDisk
from lidarlearn.data.pose_files import StampedPoses, read_numbers, stamped_poses
from lidarlearn.data.scan_files import ScanFiles, is_folder, list_scans, subfolders
from lidarlearn.data.sequence import Scan
from lidarlearn.geometry import se3

BEAMS, COLUMNS = 64, 1024
PERIOD_S = 0.1
# Of the left camera. Source: the data set's calibration, as in pyLiDAR-SLAM and KISS-ICP.
T_CAMERA_LIDAR = se3.from_rotation_translation(
    torch.from_numpy(Rotation.from_quat([0.0, 0.0, 0.924, 0.383]).as_matrix()),
    torch.tensor([-0.084, -0.025, 0.050], dtype=torch.float64),
)


@dataclass(frozen=True, eq=False, kw_only=True)
class NewerCollegeSequence(SequenceOnDisk):
    """A walk of Newer College.

    Args:
        name: e.g. 01_short_experiment.
        scans: its files.
        T_world_lidar: ground truth at the middle of each sweep; None if there is none.
        timestamps: middle of each sweep [s].
        beam_correction_deg: angle by which every beam is raised.
        empty: indices of the scans that were read and had no return.
    """

    empty: list[int] = field(default_factory=list, init=False)

    def scan(self, index: int) -> Scan:
        """Read one scan, with point times relative to the middle of the sweep; without times if columns are missing."""
        cloud = read_cloud(self.scans.path(index))
        note_returns(cloud, self.name, index, self.empty)
        whole = cloud.file_rows == BEAMS * COLUMNS
        times = (cloud.rows // BEAMS).float() / COLUMNS - 0.5 if whole else None
        return Scan(raise_beams(cloud.points, self.beam_correction_deg), times=times)


class NewerCollege(DataSetOnDisk):
    """Newer College (2020).

    Args:
        root: the folder that holds the walks, e.g. 01_short_experiment.
        projection: the image of the OS1-64.
        train_sequences: names of walks.
        val_sequences: likewise.
        test_sequences: likewise.
        max_frames: keep only the first scans of each sequence; None keeps all.
        deskew: whether odometries compensate the motion within a scan.
        beam_correction_deg: angle by which every beam is raised.
    """

    title = "Newer College"
    source = "https://ori-drs.github.io/newer-college-dataset/ (2020 release: ouster_scan and ground_truth of a walk)"
    marker = "folder like 01_short_experiment with raw_format/ouster_scan in it"

    def sequence(self, name: str) -> NewerCollegeSequence:
        """Open a walk; scans before and after its ground truth are left out."""
        scans = _scans(self.root / name)
        self.require_scans(name, scans, "cloud_*.pcd")
        truth_file = self._truth_file(name)
        truth = read_registered_poses(truth_file) if truth_file.is_file() else None
        if truth is not None:
            scans = scans.select(covered(truth_file, name, _middles(scans), truth.timestamps))
        scans = scans.first(self.max_frames)
        timestamps = _middles(scans)
        return NewerCollegeSequence(
            name=name,
            scans=scans,
            T_world_lidar=None if truth is None else truth.of_lidar(T_CAMERA_LIDAR, timestamps),
            timestamps=timestamps,
            beam_correction_deg=self.beam_correction_deg,
        )

    @staticmethod
    def is_root(path: Path) -> bool:
        """Whether a folder holds walks with scans."""
        return any(is_folder(_scan_folder(folder)) for folder in subfolders(path))

    def found(self) -> dict[str, ScanFiles]:
        """All walks."""
        return {folder.name: _scans(folder) for folder in subfolders(self.root)}

    def check_sequence(self, report: LayoutReport, name: str) -> None:
        """Scans and ground truth."""
        if not is_folder(self.root / name):
            report.missing(name, f"no folder {name}")
            return
        scans = _scans(self.root / name)
        report.describe_scans(name, scans, bytes_per_point=None)
        report.describe_ground_truth(name, self._truth_file(name), needed=name in self.test_sequences)

    def _truth_file(self, name: str) -> Path:
        return self.root / name / "ground_truth" / "registered_poses.csv"


def read_registered_poses(path: Path) -> StampedPoses:
    """Read the left camera's poses from rows of `sec, nsec, x, y, z, qx, qy, qz, qw` [s, ns, m].

    Raises:
        DamagedFileError: not such a file, or times that do not ascend.
    """
    rows = read_numbers(path, columns=9, delimiter=",")
    return stamped_poses(path, np.column_stack([rows[:, 0] + 1e-9 * rows[:, 1], rows[:, 2:]]))


def _scans(walk: Path) -> ScanFiles:
    return list_scans(_scan_folder(walk), (".pcd",), r"cloud_\d+_\d+", "cloud_1583836591_182590976.pcd")


def _middles(scans: ScanFiles) -> Float[Tensor, "n"]:
    """Time of the middle of each sweep [s], from the files' names."""
    stamps = [Path(name).stem.split("_")[1:] for name in scans.names]
    starts = [int(seconds) + 1e-9 * int(nanoseconds) for seconds, nanoseconds in stamps]
    return torch.tensor(starts, dtype=torch.float64) + PERIOD_S / 2


def _scan_folder(walk: Path) -> Path:
    return walk / "raw_format" / "ouster_scan"
