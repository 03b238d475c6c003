"""Names of methods: `<initialization>+<association>_<map>` as in the paper, an initialization alone, or a baseline."""

from collections.abc import Collection
from dataclasses import dataclass

from lidarlearn.errors import UserError


@dataclass(frozen=True)
class Method:
    """A method by its parts.

    Args:
        initialization: ni, cv, ei, posenet or the name of another network; or a baseline, which brings its own.
        backend: e.g. "kd_f2m"; None where the initialization is scored alone, and for baselines.
    """

    initialization: str
    backend: str | None = None

    def __str__(self) -> str:
        return self.initialization if self.backend is None else f"{self.initialization}+{self.backend}"


def parse_method(
    name: str, initializations: Collection[str], backends: Collection[str], baselines: Collection[str] = ()
) -> Method:
    """The method of a name such as "cv+kd_f2m" or "posenet", in any case.

    Args:
        name: as on the command line.
        initializations: names of those that there are, networks included.
        backends: names of those that there are.
        baselines: names of those that there are.

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
            f"initializations are {', '.join(initializations)}, the rest is one of {', '.join(backends)}; "
            f"for comparison there are {', '.join(baselines)}"
        )
    return Method(first, second if plus else None)
