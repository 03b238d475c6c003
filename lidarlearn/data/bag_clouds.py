"""Where the clouds of a topic are in a bag, and when each was measured."""

import logging
from dataclasses import dataclass, field
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from lidarlearn.data.bag_files import Bag, Place, Topic
from lidarlearn.data.cloud_files import returns_of
from lidarlearn.data.errors import DamagedFileError
from lidarlearn.data.point_cloud2 import fields_of
from lidarlearn.data.sweep_stamps import SweepClock, ascending, sweep_clock
from lidarlearn.progress import tracked

_log = logging.getLogger(__name__)

_LEAST_ASCENDING = 0.9  # share of the header times that must ascend, or they are not used
_PERIOD_S = 0.1  # of a sweep, if there is only one


@dataclass(frozen=True)
class Clouds:
    """The clouds of a topic whose times ascend.

    Args:
        places: of each cloud in the bag.
        timestamps: of each [s].
        rows: the rank of each among all clouds.
        count: number of all clouds; None if not all were read.
        shares_per_unit: scan periods per unit of the points' times; None if unknown.
    """

    places: tuple[Place, ...]
    timestamps: Float[Tensor, "n"]
    rows: list[int]
    count: int | None
    shares_per_unit: float | None


@dataclass
class _Headers:
    """What is read of each cloud with points: its place, and the time in its header [s], 0 for none."""

    places: list[Place] = field(default_factory=list)
    stamps: list[float] = field(default_factory=list)
    is_complete: bool = True


def read_clouds(name: str, bag: Bag, topic: Topic, max_frames: int | None, start_s: float) -> Clouds:
    """Read the first clouds of a topic for their times.

    Args:
        name: of the sequence.
        bag: the recording.
        topic: of the clouds.
        max_frames: number of clouds to read, plus those stamped before `start_s`; None reads all.
        start_s: clouds before this time do not count [s].

    Raises:
        DamagedFileError: no cloud has points.
    """
    headers = _read_headers(name, bag, topic, max_frames, start_s)
    if not headers.places:
        raise DamagedFileError(bag.path, f"no message of {topic.name} has points")
    rows, stamps = _ascending_headers(name, topic, headers.stamps), headers.stamps
    if recorded := rows is None:
        rows, stamps = list(range(len(stamps))), [1e-9 * place.time_ns for place in headers.places]
    timestamps = torch.tensor([stamps[row] for row in rows], dtype=torch.float64)
    places = tuple(headers.places[row] for row in rows)
    clock = _clock(bag, topic, places, timestamps, recorded)
    count = len(headers.places) if headers.is_complete else None
    return Clouds(places, timestamps + clock.middle_s, rows, count, clock.shares_per_unit)


def _read_headers(name: str, bag: Bag, topic: Topic, max_frames: int | None, start_s: float) -> _Headers:
    messages = bag.messages(topic.name)
    if max_frames != 1:  # a single one needs no progress bar
        messages = tracked(messages, f"reading the times of {name}", min(topic.count, max_frames or topic.count))
    headers, counted = _Headers(), 0
    for place, message in messages:
        if message.width * message.height == 0:
            continue
        headers.places.append(place)
        headers.stamps.append(_header_s(message))
        counted += (headers.stamps[-1] or 1e-9 * place.time_ns) >= start_s
        if counted == max_frames:
            headers.is_complete = False
            break
    return headers


def _ascending_headers(name: str, topic: Topic, stamps: list[float]) -> list[int] | None:
    """The clouds whose header times ascend; None if that leaves out too many, and times of recording have to do."""
    rows = ascending(stamps)
    if len(rows) < _LEAST_ASCENDING * len(stamps):
        _log.warning("%s: the times in the headers of %s do not ascend, those of recording are used", name, topic.name)
        return None
    if left_out := len(stamps) - len(rows):
        _log.warning("%s: %d clouds of %s with a time out of order are left out", name, left_out, topic.name)
    return rows


def _clock(
    bag: Bag, topic: Topic, places: tuple[Place, ...], timestamps: Float[Tensor, "n"], recorded: bool
) -> SweepClock:
    """The clock of the points, from a cloud in the middle of the recording: drivers begin with a part of a sweep."""
    middle = len(places) // 2
    onwards = (*range(middle, len(places)), *range(middle))
    try:
        clouds = ((i, returns_of(fields_of(bag.message(topic.name, places[i])))) for i in onwards)
        index, times = next(((i, cloud.times) for i, cloud in clouds if len(cloud.points)), (middle, None))
    except ValueError:  # reading that scan raises it again, with its place
        return SweepClock()
    period_s = float(timestamps.diff().median()) if len(timestamps) > 1 else None
    return sweep_clock(times, None if recorded else float(timestamps[index]), period_s, _PERIOD_S)


def ends_s(bag: Bag, topic: Topic) -> tuple[float, float]:
    """Times of the first and the last cloud [s]: from the headers, or of recording if those do not ascend."""
    (first_ns, first), (last_ns, last) = bag.ends(topic.name)
    first_s, last_s = _header_s(first), _header_s(last)
    usable = first_s < last_s or (topic.count == 1 and first_s > 0)
    return (first_s, last_s) if usable else (1e-9 * first_ns, 1e-9 * last_ns)


def _header_s(message: Any) -> float:
    return message.header.stamp.sec + 1e-9 * message.header.stamp.nanosec
