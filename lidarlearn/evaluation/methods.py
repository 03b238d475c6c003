"""Names of methods: `<initialization>+<association>_<map>` as in the paper, an initialization alone, or a baseline."""

from collections.abc import Collection
from dataclasses import dataclass

from lidarlearn.errors import UserError


@dataclass(frozen=True)
class Method:
    """The parts of a method.

    Args:
        initialization: ni, cv, ei, posenet or the name of another network; or a baseline, which is a whole odometry.
        backend: e.g. "kd_f2m"; None for an initialization alone and for baselines.
    """

    initialization: str
    backend: str | None = None

    def __str__(self) -> str:
        return self.initialization if self.backend is None else f"{self.initialization}+{self.backend}"


def parse_method(
    name: str, initializations: Collection[str], backends: Collection[str], baselines: Collection[str] = ()
) -> Method:
    """Parse the name of a method, such as "cv+kd_f2m" or "posenet", in upper or lower case.

    Args:
        name: the name on the command line.
        initializations: names of all initializations, including networks.
        backends: names of all backends.
        baselines: names of all baselines.

    Raises:
        UserError: there is no such method.
    """
    known = {known.lower(): known for known in (*initializations, *backends, *baselines)}
    first, plus, second = (known.get(part, part) for part in name.lower().partition("+"))
    if first in baselines and not plus:
        return Method(first)
    if first not in initializations or (plus and second not in backends):
        raise UserError(
            f"methods: there is no method '{name}'.\n"
            f"  change: <initialization>+<association>_<map>, e.g. cv+kd_f2m, or an initialization alone; "
            f"initializations: {', '.join(initializations)}; <association>_<map>: {', '.join(backends)}; "
            f"odometries of other projects: {', '.join(baselines)}"
        )
    return Method(first, second if plus else None)
