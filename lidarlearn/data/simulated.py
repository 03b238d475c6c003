"""Simulated drives, kept on disk as range images."""

import json
import os
import re
from collections.abc import Iterable
from pathlib import Path

import numpy as np
import torch

from lidarlearn.data.errors import DamagedFileError, DataSetNotFoundError, one_line, require_count
from lidarlearn.data.layout import LayoutReport
from lidarlearn.data.locked import locked
from lidarlearn.data.range_images import image_path, make_images, missing_images
from lidarlearn.data.sequence import DataSet, Names, Scan, Sequence
from lidarlearn.data.writable import writable
from lidarlearn.errors import UserError
from lidarlearn.geometry.projection import SphericalProjection
from lidarlearn.simulation.drive import Drive, simulator_digest
from lidarlearn.simulation.sensors import Sensor
from lidarlearn.simulation.trajectories import read_poses
from lidarlearn.simulation.worlds import PRESETS

_SOURCE = "it is simulated on the spot: call prepare(), as train.py and evaluate.py do"
_REMEDY = "delete the file; it will be made again"


class SimulatedSequence(Sequence):
    """A simulated drive whose range images are on disk.

    Args:
        drive: the settings; nothing is simulated here.
        folder: of the images.
        frames: number of scans, at most that of the drive.
    """

    def __init__(self, drive: Drive, folder: Path, frames: int) -> None:
        self.name, self._sensor, self._folder, self._frames = drive.name, drive.sensor, folder, frames
        assert drive.T_world_lidar is not None and drive.timestamps is not None
        self.T_world_lidar, self.timestamps = drive.T_world_lidar[:frames], drive.timestamps[:frames]
        self._timed, self._fingerprint = drive.motion_distortion, drive.fingerprint

    def __len__(self) -> int:
        return self._frames

    def scan(self, index: int) -> Scan:
        """Read one scan.

        Raises:
            DamagedFileError: the file is missing or truncated.
        """
        if not 0 <= index < self._frames:
            raise IndexError(f"{self.name} has scans 0 to {self._frames - 1}, asked for {index}")
        path = image_path(self._folder, index)
        try:
            ranges = np.load(path)
        except (OSError, ValueError, EOFError) as problem:
            raise DamagedFileError(path, f"no range image: {problem}", _REMEDY) from problem
        if ranges.shape != (self._sensor.beams, self._sensor.columns) or ranges.dtype != np.uint16:
            raise DamagedFileError(path, f"a {ranges.dtype} array of {ranges.shape}", _REMEDY)
        points, times = self._sensor.points(ranges, index)
        return Scan(torch.from_numpy(points), torch.from_numpy(times) if self._timed else None)

    @property
    def fingerprint(self) -> str:
        """Hash of the drive's settings."""
        return f"{self._fingerprint}-{self._frames}"


class SimulatedDataSet(DataSet):
    """Drives through simulated worlds, made by `prepare` and kept under a fingerprint of their settings.

    A sequence is called `<world>_<number>`, e.g. urban_00; worlds are urban, highway, campus and segway. Each number
    has a place and a path of its own, so that different numbers for training, validation and test never share a place.

    The range images are in `root/simulator_<digest of its code>/<name>_<digest of the settings>`, 131 kB for each scan
    of 64 beams. If the simulator changes, all drives are made again; folders of earlier simulators may be deleted.

    Args:
        root: folder of the range images; drives of any settings can share it.
        projection: the image of the sensor.
        sensor: None for the usual sensor of each world.
        train_sequences: names of the sequences to train on.
        val_sequences: names of the sequences that select the best checkpoint.
        test_sequences: names of the sequences to evaluate.
        frames: number of scans of a generated drive; a `pose_file` is followed to its end.
        seed: of all drives.
        speed: constant speed from the first scan on [m/s]; None for speeds that are usual in the world.
        static: leave out everything that moves.
        motion_distortion: cast every column from its own pose, and provide times with the points.
        pose_file: trajectory to drive, in KITTI's format, one pose per scan; None generates one for each sequence.
        pose_file_frame: "camera" for poses of KITTI's left camera, "lidar" for poses of the sensor.
        max_frames: make and keep only this many scans at the start of each sequence; None keeps all.
        deskew: whether odometries compensate the motion within a scan; only with `motion_distortion`.
        beam_correction_deg: must be 0: simulated beams need no correction.
        workers: threads that simulate; None for one per processor, at most 8. Does not affect the scans.
    """

    title = "simulated"
    check_opens = True  # scans that are not made yet cannot be opened

    def __init__(
        self,
        root: str | os.PathLike[str],
        projection: SphericalProjection,
        sensor: Sensor | None = None,
        train_sequences: Names = (),
        val_sequences: Names = (),
        test_sequences: Names = (),
        frames: int = 200,
        seed: int = 0,
        speed: float | None = None,
        static: bool = False,
        motion_distortion: bool = False,
        pose_file: str | os.PathLike[str] | None = None,
        pose_file_frame: str = "camera",
        max_frames: int | None = None,
        deskew: bool = False,
        beam_correction_deg: float = 0.0,
        workers: int | None = None,
    ) -> None:
        super().__init__(
            root, projection, train_sequences, val_sequences, test_sequences, max_frames, deskew, beam_correction_deg
        )
        if beam_correction_deg != 0:
            raise UserError(
                f"data.beam_correction_deg={beam_correction_deg}: simulated beams are as they should be.\n"
                "  change: data.beam_correction_deg=0"
            )
        if deskew and not motion_distortion:
            raise UserError(
                "data.deskew=true: these scans are not distorted by motion.\n"
                "  change: data.deskew=false, or data.motion_distortion=true"
            )
        require_count("data.frames", frames)
        self.sensor = sensor
        self.frames, self.seed, self.speed, self.static = frames, seed, speed, static
        self.motion_distortion, self.pose_file, self.pose_file_frame = motion_distortion, pose_file, pose_file_frame
        self.workers = min(os.cpu_count() or 1, 8) if workers is None else workers

    def sequence(self, name: str) -> SimulatedSequence:
        """Open a sequence.

        Raises:
            DataSetNotFoundError: it has not been made yet.
            UserError: it is not the name of a simulated drive.
        """
        drive = self._drive(name)
        folder = self.folder(drive)
        if missing := self._missing(drive):
            raise DataSetNotFoundError(self.title, f"scan {missing[0]} of sequence {name}", folder, _SOURCE)
        return SimulatedSequence(drive, folder, self._frames_of(drive))

    def check(self) -> LayoutReport:
        """Report which sequences are already made; the others can be made at any time."""
        report = LayoutReport()
        for name in self.names:
            try:
                drive = self._drive(name)
            except UserError as problem:
                report.missing(name, one_line(problem))
                continue
            frames = self._frames_of(drive)
            made = frames - len(self._missing(drive))
            note = report.found if made == frames else report.odd
            note(name, f"{made} of {frames} scans in {self.folder(drive)}" + ("" if made == frames else "; " + _SOURCE))
        return report

    def prepare(self, names: Iterable[str] | None = None) -> None:
        """Make the missing scans, showing progress; safe if two processes do so at once, or if one is killed."""
        drives = [self._drive(name) for name in (self.names if names is None else dict.fromkeys(names))]
        if not any(self._missing(drive) for drive in drives):
            return
        writable(self.root, "data.root=/path/with/room, or the environment variable LIDARLEARN_DATA")
        with locked(self.root / "simulation.lock", f"{self.root}: waiting for another process that simulates"):
            # looked up again: the other process may have made them meanwhile
            jobs = [(drive, self.folder(drive), indices) for drive in drives if (indices := self._missing(drive))]
            for drive, _, _ in jobs:
                self._describe(drive)
            if jobs:
                make_images(jobs, self.workers)

    def folder(self, drive: Drive) -> Path:
        """Folder of the range images of a drive, among those made by the same code of the simulator."""
        return self.root / f"simulator_{simulator_digest()}" / f"{drive.name}_{drive.fingerprint}"

    def _frames_of(self, drive: Drive) -> int:
        return len(drive) if self.max_frames is None else min(len(drive), self.max_frames)

    def _missing(self, drive: Drive) -> list[int]:
        return missing_images(self.folder(drive), range(self._frames_of(drive)))

    def _drive(self, name: str) -> Drive:
        match = re.fullmatch(r"([a-z]+)_(\d+)", name)
        if match is None or match[1] not in PRESETS:
            raise UserError(
                f"there is no simulated sequence {name!r}.\n"
                f"  change: {self.settings_naming(name)} to names like {', '.join(f'{world}_07' for world in PRESETS)}"
            )
        poses = None if self.pose_file is None else read_poses(Path(self.pose_file), self.pose_file_frame == "camera")
        return Drive(
            match[1],
            seed=100_000 * self.seed + int(match[2]),
            frames=self.frames if poses is None else len(poses),
            sensor=self.sensor,
            speed=self.speed,
            static=self.static,
            motion_distortion=self.motion_distortion,
            poses=poses,
            name=name,
        )

    def _describe(self, drive: Drive) -> None:
        """Write the settings beside the images, for people."""
        folder = self.folder(drive)
        folder.mkdir(parents=True, exist_ok=True)
        settings = {"world": drive.world_name, "seed": drive.seed, "frames": len(drive), "sensor": drive.sensor.name}
        settings |= {"columns": drive.sensor.columns, "static": self.static, "speed": self.speed}
        (folder / "settings.json").write_text(json.dumps(settings, indent=2), encoding="utf-8")
