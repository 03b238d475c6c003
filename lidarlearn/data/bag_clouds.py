"""The clouds of a bag's topic, in the order of time: where each is, and when it was measured."""

import logging
from dataclasses import dataclass
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

_LEAST_ASCENDING = 0.9  # of the headers' times, for them to be used
_PERIOD_S = 0.1  # of a sweep where there is but one


@dataclass(frozen=True)
class Clouds:
    """Clouds of a topic whose times ascend.

    Args:
        places: where in the bag each is.
        timestamps: of each [s].
        rows: the rank of each among all clouds.
        count: of all clouds; None where not all were read.
        shares_per_unit: of the scan period, in a unit of the points' times; None where that is unknown.
    """

    places: tuple[Place, ...]
    timestamps: Float[Tensor, "n"]
    rows: list[int]
    count: int | None
    shares_per_unit: float | None


def read_clouds(name: str, bag: Bag, topic: Topic, max_frames: int | None, start_s: float) -> Clouds:
    """The first clouds; of those stamped before `start_s` as many more as there are."""
    messages = bag.messages(topic.name)
    if max_frames != 1:  # one is there at once
        messages = tracked(messages, f"reading the times of {name}", min(topic.count, max_frames or topic.count))
    places, stamps, wanted = [], [], 0
    for place, message in messages:
        if message.width * message.height == 0:
            continue
        places.append(place)
        stamps.append(_header_s(message))
        wanted += (stamps[-1] or 1e-9 * place.time_ns) >= start_s
        if wanted == max_frames:
            break
    if not places:
        raise DamagedFileError(bag.path, f"no message of {topic.name} has points")
    rows = ascending(stamps)
    if recorded := len(rows) < _LEAST_ASCENDING * len(stamps):
        _log.warning("%s: the times in the headers of %s do not ascend, those of recording are used", name, topic.name)
        rows, stamps = list(range(len(places))), [1e-9 * place.time_ns for place in places]
    elif len(rows) < len(stamps):
        left_out = len(stamps) - len(rows)
        _log.warning("%s: %d clouds of %s with a time out of order are left out", name, left_out, topic.name)
    timestamps = torch.tensor([stamps[row] for row in rows], dtype=torch.float64)
    chosen = tuple(places[row] for row in rows)
    clock = _clock(bag, topic, chosen, timestamps, recorded)
    count = None if wanted == max_frames else len(places)
    return Clouds(chosen, timestamps + clock.middle_s, rows, count, clock.shares_per_unit)


def _clock(
    bag: Bag, topic: Topic, places: tuple[Place, ...], timestamps: Float[Tensor, "n"], recorded: bool
) -> SweepClock:
    """The clock of the points, from a cloud amid the recording: drivers begin with a part of a sweep."""
    amid = len(places) // 2
    onwards = (*range(amid, len(places)), *range(amid))
    try:
        clouds = ((i, returns_of(fields_of(bag.message(topic.name, places[i])))) for i in onwards)
        index, times = next(((i, cloud.times) for i, cloud in clouds if len(cloud.points)), (amid, None))
    except ValueError:  # whoever reads that scan is told
        return SweepClock()
    period_s = float(timestamps.diff().median()) if len(timestamps) > 1 else None
    return sweep_clock(times, None if recorded else float(timestamps[index]), period_s, _PERIOD_S)


def ends_s(bag: Bag, topic: Topic) -> tuple[float, float]:
    """Times of the first and the last cloud [s]: those of the headers, or where these do not ascend, of recording."""
    (first_ns, first), (last_ns, last) = bag.ends(topic.name)
    first_s, last_s = _header_s(first), _header_s(last)
    usable = first_s < last_s or (topic.count == 1 and first_s > 0)
    return (first_s, last_s) if usable else (1e-9 * first_ns, 1e-9 * last_ns)


def _header_s(message: Any) -> float:
    return message.header.stamp.sec + 1e-9 * message.header.stamp.nanosec
