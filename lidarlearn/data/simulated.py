"""Simulated drives, kept on disk as range images."""

import json
import os
import re
from collections.abc import Iterable
from pathlib import Path

import numpy as np
import torch

from lidarlearn.data.errors import DamagedFileError, DataSetNotFoundError, one_line, require_count
from lidarlearn.data.locked import locked
from lidarlearn.data.range_images import image_path, make_images, missing_images
from lidarlearn.data.sequence import DataSet, LayoutReport, Names, Scan, Sequence
from lidarlearn.data.writable import writable
from lidarlearn.errors import UserError
from lidarlearn.geometry.projection import SphericalProjection
from lidarlearn.simulation.drive import Drive, simulator_digest
from lidarlearn.simulation.sensors import Sensor
from lidarlearn.simulation.trajectories import read_poses
from lidarlearn.simulation.worlds import PRESETS

_SOURCE = "it is simulated on the spot: call prepare(), as train.py and evaluate.py do"


class SimulatedSequence(Sequence):
    """A simulated drive whose range images lie on disk.

    Args:
        drive: the settings; nothing is simulated as long as its images are there.
        folder: of the images.
        frames: number of scans to offer, at most the drive's.
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
            raise DamagedFileError(path, f"no range image: {problem}", "delete the file; it is made anew") from problem
        if ranges.shape != (self._sensor.beams, self._sensor.columns) or ranges.dtype != np.uint16:
            raise DamagedFileError(
                path, f"a {ranges.dtype} array of {ranges.shape}", "delete the file; it is made anew"
            )
        points, times = self._sensor.points(ranges, index)
        return Scan(torch.from_numpy(points), torch.from_numpy(times) if self._timed else None)

    @property
    def fingerprint(self) -> str:
        """Hash of the drive's settings."""
        return f"{self._fingerprint}-{self._frames}"


class SimulatedDataSet(DataSet):
    """Drives through simulated worlds, made by `prepare` and kept under a fingerprint of their settings.

    A sequence is called `<world>_<number>`, e.g. urban_00; worlds are urban, highway, campus and segway. Each number
    has a place and a way of its own: different numbers for training, validation and test are different places.

    The range images lie in `root/simulator_<digest of its code>/<name>_<digest of the settings>`, 131 kB for each scan
    of 64 beams. A changed simulator makes every drive anew; what earlier ones made lies in the folders beside its own
    and may be deleted.

    Args:
        root: folder of the range images; any two settings can share it.
        projection: the image of the sensor.
        sensor: None for the one that belongs to each world.
        train_sequences: names of the sequences to train on.
        val_sequences: names of the sequences by which the best checkpoint is chosen.
        test_sequences: names of the sequences that an evaluation runs.
        frames: scans of a drive.
        seed: of all drives.
        speed: constant speed from the first scan on [m/s]; None drives as one does there.
        static: leave out everything that moves.
        motion_distortion: cast every column from its own pose, and give times with the points.
        pose_file: path to drive, in KITTI's format, one pose per scan; None makes one for each sequence.
        pose_file_frame: "camera" for poses of KITTI's left camera, "lidar" for the sensor's own.
        max_frames: keep only the first scans of each sequence, and make no more; None keeps all.
        deskew: whether odometries compensate the motion within a scan; only with `motion_distortion`.
        beam_correction_deg: there is nothing to correct in simulated scans: must be 0.
        workers: threads that make scans; None for one per processor, at most 8. Their number changes nothing else.
    """

    title = "simulated"
    check_opens = True  # there is nothing to open before the scans are made

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
            DataSetNotFoundError: it was not made yet.
            UserError: its name is not that of a simulated drive.
        """
        drive = self._drive(name)
        folder, frames = self.folder(drive), self._wanted(drive)
        missing = missing_images(folder, range(frames))
        if missing:
            raise DataSetNotFoundError(self.title, f"scan {missing[0]} of sequence {name}", folder, _SOURCE)
        return SimulatedSequence(drive, folder, frames)

    def check(self) -> LayoutReport:
        """Which sequences were made already; those that were not can be made at any time."""
        report = LayoutReport()
        for name in self.names:
            try:
                drive = self._drive(name)
            except UserError as problem:
                report.missing(name, one_line(problem))
                continue
            frames = self._wanted(drive)
            made = frames - len(missing_images(self.folder(drive), range(frames)))
            note = report.found if made == frames else report.odd
            note(name, f"{made} of {frames} scans in {self.folder(drive)}" + ("" if made == frames else "; " + _SOURCE))
        return report

    def prepare(self, names: Iterable[str] | None = None) -> None:
        """Make the scans that are missing and show the progress; safe when two processes do it, or one is killed."""
        drives = [self._drive(name) for name in (self.names if names is None else dict.fromkeys(names))]
        if not any(missing_images(self.folder(drive), range(self._wanted(drive))) for drive in drives):
            return
        writable(self.root, "data.root=/path/with/room, or the environment variable LIDARLEARN_DATA")
        with locked(self.root / "simulation.lock", f"{self.root}: waiting for another process that simulates"):
            missing = [(d, self.folder(d), missing_images(self.folder(d), range(self._wanted(d)))) for d in drives]
            jobs = [job for job in missing if job[2]]
            for drive, _, _ in jobs:
                self._describe(drive)
            if jobs:
                make_images(jobs, self.workers)

    def folder(self, drive: Drive) -> Path:
        """Where the range images of a drive lie: with all that the same code of the simulator made."""
        return self.root / f"simulator_{simulator_digest()}" / f"{drive.name}_{drive.fingerprint}"

    def _wanted(self, drive: Drive) -> int:
        return len(drive) if self.max_frames is None else min(len(drive), self.max_frames)

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
            frames=self.frames,
            sensor=self.sensor,
            speed=self.speed,
            static=self.static,
            motion_distortion=self.motion_distortion,
            poses=poses,
            name=name,
        )

    def _describe(self, drive: Drive) -> None:
        """Write beside the images how they came about, for people who wonder."""
        folder = self.folder(drive)
        folder.mkdir(parents=True, exist_ok=True)
        settings = {"world": drive.world_name, "seed": drive.seed, "frames": len(drive), "sensor": drive.sensor.name}
        settings |= {"columns": drive.sensor.columns, "static": self.static, "speed": self.speed}
        (folder / "settings.json").write_text(json.dumps(settings, indent=2), encoding="utf-8")
