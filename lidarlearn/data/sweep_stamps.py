"""The times of sweeps, from the stamps of their messages and the times of their points."""

from bisect import bisect_left
from collections.abc import Sequence

from jaxtyping import Float
from torch import Tensor

_UNITS_S = (1.0, 1e-3, 1e-6, 1e-9)


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


def middle_after_stamp(times: Float[Tensor, "n"], stamp_s: float | None, period_s: float) -> float:
    """How long after its message's stamp the middle of a sweep is [s].

    A sweep lasts no longer than a period, which tells the unit of its points' times: s, ms, us or ns. They are relative
    to the stamp, or of the same clock; where they are of another one, the stamp is taken for the first point's.

    Args:
        times: of the points, in any unit, not all the same.
        stamp_s: of the message [s]; None for the time at which it was recorded: after the last point.
        period_s: from scan to scan.
    """
    first, last = float(times.min()), float(times.max())
    unit_s = next((unit for unit in _UNITS_S if (last - first) * unit <= 1.5 * period_s), 0.0)
    if stamp_s is None:
        return -(last - first) / 2 * unit_s
    middle_s = (first + last) / 2 * unit_s
    near = (middle_s - origin for origin in (0.0, stamp_s) if abs(middle_s - origin) <= 1.5 * period_s)
    return next(near, (last - first) / 2 * unit_s)
