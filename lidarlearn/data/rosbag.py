"""ROS bags: the point clouds (sensor_msgs/PointCloud2) of ROS 1 and ROS 2 recordings, read without conversion.

On disk: every bag in a folder is a sequence, or the root is one bag itself; `bag_files` says what a bag is. Ground
truth of the LiDAR's own poses may lie beside it or in its folder, as with `folder`: `<sequence>.tum` is interpolated at
the scans' times. A scan's time is that in its message's header, or, if its points have times, that of the middle of the
sweep, to which poses relate. If a few clouds have a time out of order, they are left out; if more than a tenth have,
the times of recording are used. Messages without points are skipped.
"""

import hashlib
import logging
import math
from dataclasses import dataclass, field
from pathlib import Path

from jaxtyping import Float
from torch import Tensor

from lidarlearn.data.bag_clouds import ends_s, read_clouds
from lidarlearn.data.bag_files import Bag, Place, bag_name, find_bags, list_files
from lidarlearn.data.cloud_files import as_scan, note_returns, require_point_times, returns_of
from lidarlearn.data.errors import DamagedFileError, one_line
from lidarlearn.data.ground_truth import (
    GroundTruth,
    describe_coverage,
    find_ground_truth,
    read_ground_truth,
)
from lidarlearn.data.layout import LayoutReport
from lidarlearn.data.on_disk import DataSetOnDisk
from lidarlearn.data.point_cloud2 import fields_of
from lidarlearn.data.scan_files import ScanFiles
from lidarlearn.data.sequence import Names, Scan, Sequence
from lidarlearn.errors import UserError
from lidarlearn.geometry.projection import SphericalProjection

_log = logging.getLogger(__name__)


@dataclass(frozen=True, eq=False, kw_only=True)
class RosbagSequence(Sequence):
    """The point clouds of one topic of a bag.

    Args:
        name: of the bag.
        bag: the recording.
        topic: name of the clouds' topic.
        places: of each cloud in the bag.
        T_world_lidar: ground truth; None if there is none.
        timestamps: of the middle of each sweep [s]; of its message if points have no times.
        shares_per_unit: scan periods per unit of the points' times; None if unknown.
        max_intensity: the value of full reflectance; None leaves intensities out.
        beam_correction_deg: angle by which every beam is raised.
        empty: indices of the scans that were read and had no return.
    """

    name: str
    bag: Bag
    topic: str
    places: tuple[Place, ...]
    T_world_lidar: Float[Tensor, "n 4 4"] | None
    timestamps: Float[Tensor, "n"]
    shares_per_unit: float | None
    max_intensity: float | None
    beam_correction_deg: float
    empty: list[int] = field(default_factory=list, init=False)

    def __len__(self) -> int:
        return len(self.places)

    def scan(self, index: int) -> Scan:
        """Read one scan, with point times, if there are any, relative to the middle of the sweep."""
        message = self.bag.message(self.topic, self.places[index])
        try:
            cloud = returns_of(fields_of(message))
        except ValueError as error:
            raise DamagedFileError(self.bag.path, f"scan {index} of {self.topic}: {error}") from error
        note_returns(cloud, self.name, index, self.empty)
        return as_scan(cloud, self.beam_correction_deg, self.max_intensity, self.shares_per_unit)

    @property
    def fingerprint(self) -> str:
        """Digest of the settings, of all times, and of the first, the middle and the last cloud."""
        settings = (self.topic, self.max_intensity, self.beam_correction_deg, self.shares_per_unit, self.places)
        digest = hashlib.sha256(repr(("Rosbag", settings)).encode())
        digest.update(self.timestamps.numpy().tobytes())
        for index in sorted({0, len(self) // 2, len(self) - 1}):
            message = self.bag.message(self.topic, self.places[index])
            digest.update(repr((message.height, message.width, message.fields)).encode() + message.data.tobytes())
        return digest.hexdigest()


class Rosbag(DataSetOnDisk):
    """Recordings of ROS.

    Args:
        root: a folder of bags, or one bag.
        projection: the image of the sensor.
        train_sequences: names of bags; None takes all.
        val_sequences: likewise.
        test_sequences: likewise.
        max_frames: keep only the first scans of each sequence; None keeps all.
        deskew: whether odometries compensate the motion within a scan; requires point times.
        beam_correction_deg: angle by which every beam is raised.
        topic: of the point clouds; None takes the only one.
        max_intensity: the value of full reflectance, e.g. 255; None leaves intensities out.
    """

    title = "ROS bags"
    source = "your own recordings: .bag of ROS 1, or folders of ROS 2 with metadata.yaml and .db3 or .mcap"
    marker = "ROS bag and no folder of bags"

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
        topic: str | None = None,
        max_intensity: float | int | None = None,
    ) -> None:
        root = Path(root).expanduser()
        there = tuple(find_bags(root)) or (bag_name(root),)
        train, val, test = (there if n is None else n for n in (train_sequences, val_sequences, test_sequences))
        super().__init__(root, projection, train, val, test, max_frames, deskew, beam_correction_deg)
        self.topic = topic
        self._sequences: dict[str, RosbagSequence] = {}
        self.max_intensity = None if max_intensity is None else float(max_intensity)

    def sequence(self, name: str) -> RosbagSequence:
        """Open a bag; the first call reads all clouds for their times."""
        if name not in self._sequences:
            bag = self._bag(name)
            if doubt := bag.doubt():
                _log.warning("%s: %s", name, doubt)
            path = find_ground_truth(bag.path, name)
            truth = None if path is None else read_ground_truth(path)
            self._sequences[name] = self._open(name, bag, self.max_frames, truth)
        return self._sequences[name]

    def open_for_check(self, name: str) -> RosbagSequence:
        """Open a bag as if it had one cloud and no ground truth: reading all clouds takes minutes."""
        return self._open(name, self._bag(name), 1, None)

    def _open(self, name: str, bag: Bag, max_frames: int | None, truth: GroundTruth | None) -> RosbagSequence:
        topic = bag.cloud_topic(self.topic)
        clouds = read_clouds(name, bag, topic, max_frames, -math.inf if truth is None else truth.start_s)
        posed = None if truth is None else truth.of_scans(name, clouds.rows, clouds.count, clouds.timestamps)
        chosen = list(range(len(clouds.places)) if posed is None else posed.indices)[:max_frames]
        sequence = RosbagSequence(
            name=name,
            bag=bag,
            topic=topic.name,
            places=tuple(clouds.places[i] for i in chosen),
            T_world_lidar=None if posed is None else posed.T_world_lidar[: len(chosen)],
            timestamps=clouds.timestamps[chosen],
            shares_per_unit=clouds.shares_per_unit,
            max_intensity=self.max_intensity,
            beam_correction_deg=self.beam_correction_deg,
        )
        if self.deskew:
            require_point_times(sequence, f"{bag.path}, {topic.name}")
        return sequence

    @staticmethod
    def is_root(path: Path) -> bool:
        """Whether a path is a bag, or a folder of bags."""
        return bool(find_bags(path))

    def found(self) -> dict[str, ScanFiles]:
        """All bags."""
        return {name: list_files(path) for name, path in find_bags(self.root).items()}

    def check_sequence(self, report: LayoutReport, name: str) -> None:
        """Size, duration, topics, and ground truth."""
        try:
            bag = self._bag(name)
            size = sum(list_files(bag.path).sizes)
            report.found(name, f"{bag.path}: {size / 1e6:,.1f} MB, {bag.duration_s():.1f} s")
            for topic in bag.topics():
                report.found(name, f"topic {topic}")
            if doubt := bag.doubt():
                report.odd(name, doubt)
            clouds = bag.cloud_topic(self.topic)
            path = find_ground_truth(bag.path, name)
            report.describe_ground_truth(name, path)
            if path is not None:
                describe_coverage(report, name, read_ground_truth(path), clouds.count, *ends_s(bag, clouds))
        except UserError as problem:
            report.missing(name, one_line(problem))

    def _bag(self, name: str) -> Bag:
        bags = find_bags(self.root)
        if name not in bags:
            raise self.not_found(name, f"a bag called {name}")
        return Bag(bags[name])
