"""Names of methods: `<initialization>+<association>_<map>` as in the paper, an initialization alone, or a baseline."""

from collections.abc import Collection
from dataclasses import dataclass

from lidarlearn.errors import UserError

INITIALIZATIONS = ("ni", "cv", "ei", "posenet")
BACKENDS = tuple(f"{association}_{map_}" for association in ("p", "kd", "vh") for map_ in ("f2f", "f2m"))
BASELINES = ("kiss_icp", "small_gicp")


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


def parse_method(name: str, networks: Collection[str] = ()) -> Method:
    """The method of a name such as "cv+kd_f2m" or "posenet", in any case.

    Args:
        name: as on the command line.
        networks: names of networks, each an initialization of its own beside "posenet".

    Raises:
        UserError: there is no such method.
    """
    initialization, plus, backend = name.lower().partition("+")
    initializations = dict.fromkeys((*INITIALIZATIONS, *networks))
    if name.lower() in BASELINES:
        return Method(name.lower())
    if initialization not in initializations or (plus and backend not in BACKENDS):
        raise UserError(
            f"methods: there is no method '{name}'.\n"
            f"  change: <initialization>+<association>_<map>, e.g. cv+kd_f2m, or an initialization alone; "
            f"initializations are {', '.join(initializations)}, the rest is one of {', '.join(BACKENDS)}; "
            f"for comparison there are {', '.join(BASELINES)}"
        )
    return Method(initialization, backend if plus else None)
