"""The health record of a frame: whether its pose can be trusted, and why not."""

import csv
from collections.abc import Iterable
from dataclasses import asdict, dataclass, fields
from pathlib import Path
from typing import Literal

Status = Literal["ok", "recovered", "coasted", "restarted"]


@dataclass(frozen=True)
class Health:
    """What is known about the registration of one scan; None if it was not registered.

    Args:
        frame: index of the scan.
        status: "ok"; "recovered": the first registration was doubtful, and the best of several was kept; "coasted": no
            registration was acceptable, and the pose is predicted; "restarted": the pose is predicted, and a new map
            starts with this scan.
        initialization: source of the guess: the initialization's name for itself, e.g. ni, cv, ei or posenet; "start":
            the best of many motions, as none is known; "recovery": a motion tried after a doubtful registration.
        points: number of points to register.
        iterations: number of Gauss-Newton steps.
        converged: whether the last step was below the tolerances.
        overlap: share of the points that have a neighbour in the map.
        inlier_share: share of these points that lie on the map's surface.
        rmse_m: weighted root mean square of the residuals [m].
        skew_m: translation over a scan period that remains after deskewing [m], see `RegistrationResult.skew`.
        skew_deg: rotation over a scan period that remains after deskewing [deg].
        min_information: `RegistrationResult.information` along the weakest direction.
        degenerate: whether that is too little to rely on the motion along this direction. Below
            `registration.min_information` the guess of the motion along it is kept.
        weakest_direction: that direction, a unit vector in the sensor's frame.
        deviation_m: distance between the registered motion and constant velocity [m].
        deviation_deg: angle between the two [deg].
        implausible: whether the deviation is more than a vehicle can do in one scan.
    """

    frame: int
    status: Status = "ok"
    initialization: str = "start"
    points: int = 0
    iterations: int | None = None
    converged: bool | None = None
    overlap: float | None = None
    inlier_share: float | None = None
    rmse_m: float | None = None
    skew_m: float | None = None
    skew_deg: float | None = None
    min_information: float | None = None
    degenerate: bool = False
    weakest_direction: tuple[float, ...] | None = None
    deviation_m: float | None = None
    deviation_deg: float | None = None
    implausible: bool = False

    @property
    def flagged(self) -> bool:
        """Whether the pose should not be trusted blindly."""
        return self.status != "ok" or self.degenerate or self.implausible


_AXES = ("x", "y", "z")


def write_health(path: Path, records: Iterable[Health]) -> None:
    """Write one row per frame as CSV, with empty cells for None; the weakest direction takes three columns."""
    names = [f.name for f in fields(Health) if f.name != "weakest_direction"]
    with path.open("w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file)
        writer.writerow([*names, "flagged", *(f"weakest_{axis}" for axis in _AXES)])
        for record in records:
            row = asdict(record)
            direction = row.pop("weakest_direction") or (None,) * len(_AXES)
            writer.writerow([*(_cell(row[n]) for n in names), record.flagged, *(_cell(v) for v in direction)])


def _cell(value: object) -> object:
    return f"{value:.6g}" if isinstance(value, float) else value
