"""ROS bags, read with the library `rosbags`: their topics, and the PointCloud2 messages of a topic.

A bag is a file (.bag of ROS 1, a single .db3 or .mcap of ROS 2), a folder with the metadata.yaml of ROS 2, or a folder
of such files: the parts into which a recorder split one recording.
"""

import os
import re
from collections import Counter, deque
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from functools import cache
from itertools import islice, pairwise
from pathlib import Path
from typing import Any

from lidarlearn.data.errors import DamagedFileError
from lidarlearn.data.scan_files import ScanFiles, full_path, holds_scans, list_scans, natural_key, subfolders
from lidarlearn.errors import UserError

SUFFIXES = (".bag", ".db3", ".mcap")
POINT_CLOUD = "sensor_msgs/msg/PointCloud2"
_METADATA, _COMPRESSED = "metadata.yaml", ".zstd"
_LONGEST_PAUSE_S, _LONGEST_OVERLAP_S = 10.0, 1.0  # between parts of one recording
_REPAIR = (
    "copy or download it again, or repair what a recorder left unfinished: `rosbag reindex BAG`,"
    " `ros2 bag reindex FOLDER`, `mcap recover FILE`"
)
_NO_DAMAGE = {  # what to change for errors of the library that mean no damage
    "Unrecognized storage format": "the name of the file, to a suffix in small letters",
    "Profile is not ros2": "data.root to the .bag from which it was converted: an .mcap of ROS 1 is not read",
}


def find_bags(root: Path) -> dict[str, Path]:
    """The bags of a folder by name, in natural order: all in it, or it alone where it is one itself.

    A bag is named like its folder, or its file without the suffix; with it where two would share a name.
    """
    if _is_file(root) or os.path.isfile(root / _METADATA):
        return {bag_name(root): root}
    files = list_scans(root, SUFFIXES)
    bags = [files.path(i) for i in range(len(files))]
    bags += [f for f in subfolders(root) if os.path.isfile(f / _METADATA) or holds_scans(f, SUFFIXES)]
    alike = Counter(map(bag_name, bags))
    named = {bag_name(bag) if alike[bag_name(bag)] == 1 else bag.name: bag for bag in bags}
    return dict(sorted(named.items(), key=lambda bag: natural_key(bag[0])))


def bag_name(path: Path) -> str:
    """A folder's name, or a file's without its suffix."""
    return path.stem if _is_file(path) else full_path(path).name


def list_files(bag: Path) -> ScanFiles:
    """The files that hold a bag's messages."""
    if _is_file(bag):
        return ScanFiles(bag.parent, (bag.name,), (bag.stat().st_size,))
    return list_scans(bag, (*SUFFIXES, _COMPRESSED))


@dataclass(frozen=True)
class Topic:
    """A topic of a bag.

    Args:
        name: e.g. /os_cloud_node/points.
        kind: type of its messages, e.g. sensor_msgs/msg/PointCloud2.
        count: number of its messages.
    """

    name: str
    kind: str
    count: int

    def __str__(self) -> str:
        return f"{self.name} ({self.kind}, {self.count} messages)"


@dataclass(frozen=True, slots=True)
class Place:
    """Where a message is: its part of the bag, its time of recording [ns], and its rank among messages of that time."""

    part: int
    time_ns: int
    rank: int


class Bag:
    """A bag, opened when it is first read, and once per process: processes cannot share a position in a file.

    All methods that read raise DamagedFileError if it is no bag or damaged, and UserError if the library is missing.

    Args:
        path: of the file or folder.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self._readers: list[Any] = []
        self._files = ExitStack()
        self._process = -1

    def __reduce__(self) -> tuple[type["Bag"], tuple[Path]]:
        return Bag, (self.path,)

    def __del__(self) -> None:
        self._files.close()

    def topics(self) -> list[Topic]:
        """All topics, by name."""
        counts: Counter[tuple[str, str]] = Counter()
        for connection in (c for reader in self._opened() for c in reader.connections):
            counts[connection.topic, connection.msgtype] += connection.msgcount
        return [Topic(name, kind, count) for (name, kind), count in sorted(counts.items())]

    def duration_s(self) -> float:
        """From the first to the last message of any topic [s]."""
        readers = [reader for reader in self._opened() if reader.message_count]
        ends = [reader.end_time for reader in readers]
        return 1e-9 * (max(ends) - min(reader.start_time for reader in readers)) if ends else 0.0

    def doubt(self) -> str | None:
        """Why its parts may not belong to one recording; None if they seem to."""
        readers = [reader for reader in self._opened() if reader.message_count]
        pauses = [1e-9 * (b.start_time - a.end_time) for a, b in pairwise(readers)]
        odd = [pause for pause in pauses if not -_LONGEST_OVERLAP_S <= pause <= _LONGEST_PAUSE_S]
        if not odd:
            return None
        seen = f"overlap by {-odd[0]:,.0f} s" if odd[0] < 0 else f"are {odd[0]:,.0f} s apart"
        return (
            f"{self.path}: its {len(readers)} bags are read as parts of one recording, but two of them {seen};"
            f" data.root={self.path} reads each as a sequence"
        )

    def cloud_topic(self, wanted: str | None) -> Topic:
        """The topic to read.

        Args:
            wanted: its name; None for the only one with point clouds.

        Raises:
            UserError: there is no such topic, or there are several.
        """
        topics = self.topics()
        clouds = [topic for topic in topics if topic.kind == POINT_CLOUD and topic.count]
        chosen = [topic for topic in clouds if wanted in (None, topic.name)]
        if len(chosen) == 1:
            return chosen[0]
        if not clouds:
            shown = ", ".join(map(str, topics)) or "nothing"
            raise UserError(
                f"{self.path}: no PointCloud2 messages in it, only {shown}.\n"
                "  change: record the sensor's point clouds (of packets: run the driver on them and record its output)"
            )
        seen = "several topics hold point clouds" if wanted is None else f"no point clouds in topic {wanted}"
        raise UserError(f"{self.path}: {seen}.\n  change: data.topic to one of {', '.join(map(str, clouds))}")

    def messages(self, topic: str) -> Iterator[tuple[Place, Any]]:
        """All PointCloud2 messages of a topic in the order of recording, each with its place."""
        for part, reader in enumerate(self._opened()):
            before, rank = None, 0
            connections = _connections(reader, topic)
            with _readable(self.path):
                for _, time_ns, raw in reader.messages(connections) if connections else ():  # an empty list means all
                    rank = rank + 1 if time_ns == before else 0
                    before = time_ns
                    yield Place(part, time_ns, rank), _decode(reader, raw)

    def ends(self, topic: str) -> tuple[tuple[int, Any], tuple[int, Any]]:
        """The first and the last PointCloud2 message of a topic, each with its time of recording [ns]."""
        place, first = next(self.messages(topic))
        reader = next(r for r in reversed(self._opened()) if _connections(r, topic))
        with _readable(self.path):
            # searched from the end: reading a whole bag takes minutes
            starts = (*(reader.end_time - seconds * 10**9 for seconds in (1, 10, 100)), None)
            found = (deque(reader.messages(_connections(reader, topic), start=start), maxlen=1) for start in starts)
            _, last_ns, raw = next(filter(None, found))[0]
            return (place.time_ns, first), (last_ns, _decode(reader, raw))

    def message(self, topic: str, place: Place) -> Any:
        """One PointCloud2 message."""
        reader = self._opened()[place.part]
        with _readable(self.path):
            there = reader.messages(_connections(reader, topic), start=place.time_ns, stop=place.time_ns + 1)
            return _decode(reader, next(islice(there, place.rank, None))[2])

    def _opened(self) -> list[Any]:
        """Readers of the parts in the order of time."""
        if self._process != os.getpid():
            self._files.close()
            parts = self._parts()
            with _readable(self.path), ExitStack() as files:
                readers = [files.enter_context(_reader(path)) for path in parts]
                self._readers = sorted(readers, key=lambda reader: reader.start_time)
                self._files, self._process = files.pop_all(), os.getpid()
        return self._readers

    def _parts(self) -> list[Path]:
        if _is_file(self.path):
            return [self.path]
        if (self.path / _METADATA).is_file():
            if holds_scans(self.path, (_COMPRESSED,)):  # every process would unpack it
                raise UserError(
                    f"{self.path}: its files are compressed as a whole.\n"
                    f"  change: unpack it once, `rosbags-convert --src {self.path} --dst NEW_FOLDER`"
                )
            return [self.path]
        files = list_scans(self.path, SUFFIXES)
        if len(kinds := {Path(name).suffix.lower() for name in files.names}) > 1:
            raise UserError(
                f"{self.path}: bags of several kinds ({', '.join(sorted(kinds))}) are no parts of one recording.\n"
                "  change: keep the parts of one recording in a folder"
            )
        return [files.path(i) for i in range(len(files))]


def _is_file(path: Path) -> bool:
    return path.suffix.lower() in SUFFIXES and os.path.isfile(path)  # false without permission


def _reader(part: Path) -> Any:
    try:
        from rosbags import rosbag1, rosbag2
    except ModuleNotFoundError as error:
        raise UserError(
            "reading ROS bags needs the package rosbags.\n"
            "  change: pip install 'lidarlearn[rosbag]' (in a copy of the repository: pip install -e '.[rosbag]')"
        ) from error
    return rosbag1.Reader(part) if part.suffix.lower() == ".bag" else rosbag2.Reader(part)


def _connections(reader: Any, topic: str) -> list[Any]:
    return [c for c in reader.connections if (c.topic, c.msgtype) == (topic, POINT_CLOUD) and c.msgcount]


def _decode(reader: Any, raw: bytes) -> Any:
    from rosbags import rosbag1

    if isinstance(reader, rosbag1.Reader):
        return _types("ros1_noetic").deserialize_ros1(raw, POINT_CLOUD)
    return _types("ros2_humble").deserialize_cdr(raw, POINT_CLOUD)


@cache
def _types(release: str) -> Any:
    """The message types of a release: PointCloud2 is the same in all, and not every bag defines it itself."""
    from rosbags.typesys import Stores, get_typestore

    return get_typestore(Stores(release))


@contextmanager
def _readable(path: Path) -> Iterator[None]:
    try:
        yield
    except UserError:
        raise
    except Exception as error:  # of the library, its assertions, struct, SQLite and decompressors
        lines = str(error).splitlines() or [type(error).__name__]
        problem = f"cannot be read as a ROS bag ({lines[0].rstrip('.')})"
        raise DamagedFileError(path, problem, _remedy(path, problem)) from error


def _remedy(path: Path, problem: str) -> str:
    if "unable to open database file" in problem and re.search(r"[#?]|%[0-9a-fA-F]{2}", str(path)):
        return "the names in its path that hold #, ? or %: the library rosbags finds no .db3 there"
    return next((remedy for words, remedy in _NO_DAMAGE.items() if words in problem), _REPAIR)
