"""The times of sweeps, from the stamps of their messages and the times of their points."""

from bisect import bisect_left
from collections.abc import Sequence
from dataclasses import dataclass

from jaxtyping import Float
from torch import Tensor

_UNITS_S = (1.0, 1e-3, 1e-6, 1e-9)
_LEAST, _MOST = 0.15, 1.5  # that a sweep lasts, in periods


def ascending(stamps: Sequence[float]) -> list[int]:
    """Indices of as many stamps as possible that ascend from one to the next; 0 stands for no stamp, as in ROS."""
    ends: list[float] = []  # least stamp with which so many can end
    at_ends: list[int] = []
    before: dict[int, int] = {}
    for index, stamp in enumerate(stamps):
        if stamp == 0:
            continue
        length = bisect_left(ends, stamp)
        ends[length : length + 1], at_ends[length : length + 1] = [stamp], [index]
        before[index] = at_ends[length - 1] if length else -1
    chosen = at_ends[-1:]
    while chosen and before[chosen[-1]] >= 0:
        chosen.append(before[chosen[-1]])
    return chosen[::-1]


@dataclass(frozen=True)
class SweepClock:
    """How the times of points relate to those of scans.

    Args:
        middle_s: how long after its message's stamp the middle of a sweep is [s].
        shares_per_unit: of the scan period, in a unit of the points' times; None where that is unknown.
    """

    middle_s: float = 0.0
    shares_per_unit: float | None = None


def unit_s(times: Float[Tensor, "n"], period_s: float) -> float | None:
    """The unit of points' times, s, ms, us or ns, in which a sweep lasts for a good part of a period; else None.

    A sensor may look into a part of the circle; a hundredth of it is rather times of another unit, or shares already.

    Args:
        times: of the points, not all the same.
        period_s: from scan to scan.
    """
    span = float(times.max() - times.min())
    return next((unit for unit in _UNITS_S if _LEAST * period_s <= span * unit <= _MOST * period_s), None)


def sweep_clock(
    times: Float[Tensor, "n"] | None, stamp_s: float | None, period_s: float | None, usual_period_s: float
) -> SweepClock:
    """Read the clock of points' times off one sweep.

    They are relative to the message's stamp, or of the same clock; where they are of another one, the stamp is taken
    for the first point's.

    Args:
        times: of the points, in any unit; None where they have none.
        stamp_s: of the message [s]; None for the time at which it was recorded: after the last point.
        period_s: from scan to scan; None where there is but one.
        usual_period_s: of such a one.
    """
    longest_s = period_s or usual_period_s
    if times is None or not varied(times) or (unit := unit_s(times, longest_s)) is None:
        return SweepClock()
    first_s, last_s = float(times.min()) * unit, float(times.max()) * unit
    shares_per_unit = None if period_s is None else unit / period_s
    if stamp_s is None:
        return SweepClock(-(last_s - first_s) / 2, shares_per_unit)
    middle_s = (first_s + last_s) / 2
    near = (middle_s - origin for origin in (0.0, stamp_s) if abs(middle_s - origin) <= _MOST * longest_s)
    return SweepClock(next(near, (last_s - first_s) / 2), shares_per_unit)


def varied(times: Float[Tensor, "n"]) -> bool:
    """Whether times differ from each other: drivers that know none write zeros."""
    return bool((times != times[:1]).any())
