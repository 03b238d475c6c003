"""A folder of your own scans: .bin, .npy, .pcd or .ply in natural name order, ground truth optional.

On disk: every subfolder with scans is a sequence, or else the folder itself is one. If both hold scans, the folder is
only read if its name is configured. A sequence may have `times.txt` (a time [s] per scan) beside its scans, and ground
truth of the LiDAR's own poses in KITTI's or TUM's format: `poses.txt`, `poses.tum`, `groundtruth.txt` beside the scans,
or `<sequence>.txt`, `<sequence>.tum` beside the folder.
KITTI rows follow the scans' order. TUM rows are interpolated at the scans' times, and scans before or after them are
left out; without scan times they follow the scans' order, too. Poses relate to the middle of a sweep. The scan period,
by which the points' times are divided, comes from the scans' times.
"""

import logging
from collections.abc import Iterable
from dataclasses import dataclass, field
from pathlib import Path

from jaxtyping import Float
from torch import Tensor

from lidarlearn.data.cloud_files import SUFFIXES, as_scan, note_returns, read_cloud, require_point_times
from lidarlearn.data.errors import DamagedFileError
from lidarlearn.data.ground_truth import find_ground_truth, read_ground_truth
from lidarlearn.data.layout import LayoutReport
from lidarlearn.data.on_disk import DataSetOnDisk, SequenceOnDisk
from lidarlearn.data.pose_files import read_times
from lidarlearn.data.scan_files import ScanFiles, full_path, holds_scans, is_folder, list_scans, subfolders
from lidarlearn.data.sequence import Names, Scan, Sequence
from lidarlearn.data.sweep_stamps import sweep_clock
from lidarlearn.errors import UserError
from lidarlearn.geometry.projection import SphericalProjection

_log = logging.getLogger(__name__)


@dataclass(frozen=True, eq=False, kw_only=True)
class FolderSequence(SequenceOnDisk):
    """The scans of one folder.

    Args:
        name: of the folder.
        scans: its files.
        T_world_lidar: ground truth; None if there is none.
        timestamps: from times.txt [s]; None if there is none.
        shares_per_unit: scan periods per unit of the points' times; None if unknown.
        bin_columns: numbers per point of a .bin file.
        max_intensity: the value of full reflectance; None leaves intensities out.
        beam_correction_deg: angle by which every beam is raised.
        empty: indices of the scans that were read and had no return.
    """

    shares_per_unit: float | None
    bin_columns: int
    max_intensity: float | None
    empty: list[int] = field(default_factory=list, init=False)

    def scan(self, index: int) -> Scan:
        """Read one scan, with point times, if the file has any, relative to the middle of the sweep."""
        cloud = read_cloud(self.scans.path(index), self.bin_columns)
        note_returns(cloud, self.name, index, self.empty)
        return as_scan(cloud, self.beam_correction_deg, self.max_intensity, self.shares_per_unit)


class Folder(DataSetOnDisk):
    """A folder of scans.

    Args:
        root: a folder of scans, or of such folders.
        projection: the image of the sensor.
        train_sequences: names of subfolders; None takes all, or the folder itself.
        val_sequences: likewise.
        test_sequences: likewise.
        max_frames: keep only the first scans of each sequence; None keeps all.
        deskew: whether odometries compensate the motion within a scan; requires point times in the files.
        beam_correction_deg: angle by which every beam is raised.
        bin_columns: numbers per point of a .bin file: 4 as in KITTI, 5 as in nuScenes.
        max_intensity: the value of full reflectance, e.g. 255; None leaves intensities out.
    """

    title = "folder of scans"
    source = "your own recordings: one folder of .bin, .npy, .pcd or .ply files for each sequence"
    marker = "scans and no folder of scans"

    def __init__(
        self,
        root: str | Path,
        projection: SphericalProjection,
        train_sequences: Names | None = None,
        val_sequences: Names | None = None,
        test_sequences: Names | None = None,
        max_frames: int | None = None,
        deskew: bool = False,
        beam_correction_deg: float | int = 0.0,
        bin_columns: int = 4,
        max_intensity: float | int | None = None,
    ) -> None:
        root = Path(root).expanduser()
        there = find_sequences(root) or (full_path(root).name,)
        train, val, test = (there if n is None else n for n in (train_sequences, val_sequences, test_sequences))
        super().__init__(root, projection, train, val, test, max_frames, deskew, beam_correction_deg)
        self.bin_columns = bin_columns
        self.max_intensity = None if max_intensity is None else float(max_intensity)

    def sequence(self, name: str) -> FolderSequence:
        """Open a folder of scans; those not covered by ground truth with times are left out."""
        folder = self._folder(name)
        files = list_scans(folder, SUFFIXES)
        if not len(files):
            raise self.not_found(name, f"{name}: scans (.bin, .npy, .pcd or .ply)")
        if len(kinds := _kinds(files)) > 1:
            raise UserError(
                f"{folder}: scans of several kinds ({', '.join(kinds)}).\n  change: keep one kind in a folder"
            )
        timestamps = _timestamps(folder, len(files))
        posed, truth = None, find_ground_truth(folder)
        if truth is not None:
            posed = read_ground_truth(truth).of_scans(name, range(len(files)), len(files), timestamps)
        chosen = (range(len(files)) if posed is None else posed.indices)[: self.max_frames]
        sequence = FolderSequence(
            name=name,
            scans=files.select(chosen),
            T_world_lidar=None if posed is None else posed.T_world_lidar[: len(chosen)],
            timestamps=None if timestamps is None else timestamps[list(chosen)],
            shares_per_unit=self._shares_per_unit(files, timestamps),
            bin_columns=self.bin_columns,
            max_intensity=self.max_intensity,
            beam_correction_deg=self.beam_correction_deg,
        )
        if self.deskew:
            require_point_times(sequence, str(files.path(0)))
        return sequence

    def sequences(self, names: Iterable[str]) -> dict[str, Sequence]:
        """Open several sequences; warn of scans that belong to none."""
        if remark := self._remark_on_others():
            _log.warning(remark)
        return super().sequences(names)

    def check(self) -> LayoutReport:
        """Describe this folder, and scans in it that belong to no sequence."""
        report = super().check()
        if remark := self._remark_on_others():
            report.odd("root", remark)
        return report

    def field_of_view_warning(self, name: str, points: Float[Tensor, "n 3"]) -> str | None:
        """As for any data set; .bin files may also have another number of columns."""
        remark = super().field_of_view_warning(name, points)
        if remark is None or _kinds(list_scans(self._folder(name), SUFFIXES)) != [".bin"]:
            return remark
        return f"{remark},\n  or data.bin_columns where these files do not have {self.bin_columns} numbers to a point"

    @staticmethod
    def is_root(path: Path) -> bool:
        """Whether a folder holds scans, or folders of scans."""
        return bool(find_sequences(path))

    def found(self) -> dict[str, ScanFiles]:
        """All subfolders with scans, or the folder itself."""
        return {name: list_scans(self._folder(name), SUFFIXES) for name in find_sequences(self.root)}

    def check_sequence(self, report: LayoutReport, name: str) -> None:
        """Scans of one kind, times and ground truth."""
        folder = self._folder(name)
        if not is_folder(folder):
            report.missing(name, f"no folder {name}")
            return
        scans = list_scans(folder, SUFFIXES)
        kinds = _kinds(scans)
        report.describe_scans(name, scans, 4 * self.bin_columns if kinds == [".bin"] else None)
        if len(kinds) > 1:
            report.missing(name, f"scans of several kinds: {', '.join(kinds)}")
        if (folder / "times.txt").is_file():
            report.describe_rows(name, folder / "times.txt", "times", len(scans))
        report.describe_ground_truth(name, find_ground_truth(folder))

    def _remark_on_others(self) -> str | None:
        """A remark on scans beside folders of scans, if all of the folders are configured and the scans are not."""
        own, others = full_path(self.root).name, list_scans(self.root, SUFFIXES)
        if not len(others) or own in self.names or not set(find_sequences(self.root)) <= set(self.names):
            return None
        return (
            f"{len(others)} scans in {self.root} itself are left out, as folders in it hold scans, too;"
            f" 'data.test_sequences=[\"{own}\"]' reads them"
        )

    def _shares_per_unit(self, files: ScanFiles, timestamps: Float[Tensor, "n"] | None) -> float | None:
        """Scan periods per unit of the points' times, from the file in the middle of the recording."""
        if timestamps is None or len(files) < 2 or _kinds(files) == [".bin"]:
            return None
        period_s = float(timestamps.diff().median())
        try:
            times = read_cloud(files.path(len(files) // 2)).times
        except UserError:  # reading that scan raises it again
            return None
        return None if times is None else sweep_clock(times, 0.0, period_s, period_s).shares_per_unit

    def _folder(self, name: str) -> Path:
        folder = self.root / name
        return self.root if name == full_path(self.root).name and not is_folder(folder) else folder


def find_sequences(root: Path) -> tuple[str, ...]:
    """Names of the subfolders that hold scans; else the folder's own name if it holds scans itself; else nothing."""
    names = tuple(folder.name for folder in subfolders(root) if holds_scans(folder, SUFFIXES))
    return names or ((full_path(root).name,) if holds_scans(root, SUFFIXES) else ())


def _timestamps(folder: Path, count: int) -> Float[Tensor, "n"] | None:
    path = folder / "times.txt"
    if not path.is_file():
        return None
    times = read_times(path)
    if len(times) != count:
        raise DamagedFileError(path, f"{len(times)} times for {count} scans", "give every scan a row")
    return times


def _kinds(scans: ScanFiles) -> list[str]:
    return sorted({Path(name).suffix.lower() for name in scans.names})
