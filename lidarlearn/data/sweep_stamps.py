"""Times of sweeps, from the stamps of their messages and the times of their points."""

from bisect import bisect_left
from collections.abc import Sequence
from dataclasses import dataclass

from jaxtyping import Float
from torch import Tensor

_UNITS_S = (1.0, 1e-3, 1e-6, 1e-9)
_SHORTEST, _LONGEST = 0.15, 1.5  # duration of a sweep, in scan periods


def ascending(stamps: Sequence[float]) -> list[int]:
    """Indices of the longest strictly ascending subsequence of stamps; 0 stands for no stamp, as in ROS."""
    last_stamps: list[float] = []  # smallest last stamp of the subsequences of each length
    last_indices: list[int] = []
    previous: dict[int, int] = {}  # index before each one in its subsequence, -1 for none
    for index, stamp in enumerate(stamps):
        if stamp == 0:
            continue
        length = bisect_left(last_stamps, stamp)
        last_stamps[length : length + 1], last_indices[length : length + 1] = [stamp], [index]
        previous[index] = last_indices[length - 1] if length else -1
    chosen = last_indices[-1:]
    while chosen and previous[chosen[-1]] >= 0:
        chosen.append(previous[chosen[-1]])
    return chosen[::-1]


@dataclass(frozen=True)
class SweepClock:
    """How the times of points relate to those of scans.

    Args:
        middle_s: time from the stamp of the message to the middle of the sweep [s].
        shares_per_unit: scan periods per unit of the points' times; None if the unit is unknown.
    """

    middle_s: float = 0.0
    shares_per_unit: float | None = None


def unit_s(times: Float[Tensor, "n"], period_s: float) -> float | None:
    """The unit [s] of points' times, s, ms, us or ns, in which a sweep lasts for a good part of the period; else None.

    A sensor may scan only a part of the circle. A sweep that seems to last for a hundredth of the period, however, has
    times in another unit, or shares of the period.

    Args:
        times: of the points, not all the same.
        period_s: time from scan to scan [s].
    """
    span = float(times.max() - times.min())
    return next((unit for unit in _UNITS_S if _SHORTEST * period_s <= span * unit <= _LONGEST * period_s), None)


def sweep_clock(
    times: Float[Tensor, "n"] | None, stamp_s: float | None, period_s: float | None, usual_period_s: float
) -> SweepClock:
    """Derive the clock of the points' times from one sweep.

    Their times are relative to the stamp of the message, or absolute on the same clock. If they are on another clock,
    the stamp is taken to be the time of the first point.

    Args:
        times: of the points, in any unit; None if they have none.
        stamp_s: of the message [s]; None if only the time of recording is known, which is after the last point.
        period_s: time from scan to scan [s]; None if there is only one scan.
        usual_period_s: taken instead in that case [s].
    """
    expected_s = period_s or usual_period_s
    if times is None or not varied(times) or (unit := unit_s(times, expected_s)) is None:
        return SweepClock()
    first_s, last_s = float(times.min()) * unit, float(times.max()) * unit
    shares_per_unit = None if period_s is None else unit / period_s
    if stamp_s is None:
        return SweepClock(-(last_s - first_s) / 2, shares_per_unit)
    middle_s = (first_s + last_s) / 2
    near = (middle_s - origin for origin in (0.0, stamp_s) if abs(middle_s - origin) <= _LONGEST * expected_s)
    return SweepClock(next(near, (last_s - first_s) / 2), shares_per_unit)


def varied(times: Float[Tensor, "n"]) -> bool:
    """Whether times differ from each other; drivers without times write zeros."""
    return bool((times != times[:1]).any())
