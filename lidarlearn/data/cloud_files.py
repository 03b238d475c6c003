"""Point clouds in .bin, .npy, .pcd and .ply files, reduced to points, intensities and times."""

import logging
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from numpy.typing import NDArray
from torch import Tensor

from lidarlearn.data.beam_correction import raise_beams
from lidarlearn.data.errors import DamagedFileError
from lidarlearn.data.pcd import read_pcd
from lidarlearn.data.ply import read_ply
from lidarlearn.data.scan_files import read_float32_rows
from lidarlearn.data.sequence import Scan, Sequence
from lidarlearn.data.sweep_stamps import varied
from lidarlearn.errors import UserError

_log = logging.getLogger(__name__)

SUFFIXES = (".bin", ".npy", ".pcd", ".ply")
_INTENSITY_NAMES = ("intensity", "scalar_intensity", "intensities", "reflectivity", "reflectance")
_TIME_NAMES = ("t", "time", "timestamp", "time_stamp", "timestamps", "offset_time", "scalar_time", "scalar_timestamp")


@dataclass(frozen=True)
class Cloud:
    """The returns of a scan as a file holds them.

    Args:
        points: float32 [m], finite, without the origin: it stands for "no return".
        intensities: in the file's unit; None if there are none.
        times: in the file's unit and from its origin, float64; None if there are none.
        rows: index of each point in the file, where points without a return count, too.
        file_rows: number of points in the file.
    """

    points: Float[Tensor, "n 3"]
    intensities: Float[Tensor, "n"] | None
    times: Float[Tensor, "n"] | None
    rows: Int[Tensor, "n"]
    file_rows: int

    def select(self, chosen: Bool[Tensor, "n"]) -> "Cloud":
        """The chosen points."""
        intensities = None if self.intensities is None else self.intensities[chosen]
        times = None if self.times is None else self.times[chosen]
        return Cloud(self.points[chosen], intensities, times, self.rows[chosen], self.file_rows)


def read_cloud(path: Path, bin_columns: int = 4) -> Cloud:
    """Read a scan; the suffix tells the format.

    Args:
        path: .bin (float32 rows x, y, z, intensity, ...), .npy (the same as an array, or named fields), .pcd or .ply.
        bin_columns: numbers per point of a .bin file: 4 as in KITTI, 5 as in nuScenes.

    Raises:
        DamagedFileError: not such a file, no point in it, or a point that is not finite in a .bin or a .npy without
            names. In other files such a point stands for "no return".
    """
    match path.suffix.lower():
        case ".bin":
            fields = _columns(read_float32_rows(path, bin_columns).numpy())
        case ".npy":
            fields = _read_npy(path)
        case ".pcd":
            fields = read_pcd(path)
        case ".ply":
            fields = read_ply(path)
        case _:
            raise DamagedFileError(path, f"not one of {', '.join(SUFFIXES)}")
    try:
        return returns_of(fields)
    except ValueError as error:
        raise DamagedFileError(path, str(error)) from error


def returns_of(fields: Mapping[str, NDArray[Any]]) -> Cloud:
    """Points, intensities and times of the returns; there may be none, as drivers send grids without any return, too.

    Args:
        fields: a value per point, by the name of the field in lower case; see the names above.

    Raises:
        ValueError: no coordinates, or no points.
    """
    if not {"x", "y", "z"} <= fields.keys():
        raise ValueError(f"no fields x, y and z, only {', '.join(fields) or 'none'}")
    points = torch.from_numpy(np.stack([np.asarray(fields[axis], np.float32) for axis in "xyz"], axis=1))
    if not len(points):
        raise ValueError("a scan without a single point")
    intensities, times = (
        next((torch.from_numpy(np.asarray(fields[n]).astype(dtype)) for n in names if n in fields), None)
        for names, dtype in ((_INTENSITY_NAMES, np.float32), (_TIME_NAMES, np.float64))
    )
    returned = points.isfinite().all(dim=1) & (points != 0).any(dim=1)
    if times is not None:
        returned &= times.isfinite()
    return Cloud(points, intensities, times, torch.arange(len(points)), len(points)).select(returned)


def as_scan(
    cloud: Cloud, beam_correction_deg: float, max_intensity: float | None, shares_per_unit: float | None = None
) -> Scan:
    """The scan that a file holds, with point times, if there are any, relative to the middle of the sweep.

    Args:
        cloud: as read from the file.
        beam_correction_deg: angle by which every beam is raised.
        max_intensity: the value of full reflectance; None leaves intensities out.
        shares_per_unit: scan periods per unit of the points' times. Points a period or more from the median time are
            left out, since their times are invalid. None if unknown: a sweep is assumed to last for one period.
    """
    if cloud.times is not None and shares_per_unit is not None and len(cloud.points):
        cloud = cloud.select((cloud.times - cloud.times.median()).abs() * shares_per_unit < 1)
    intensities = None
    if max_intensity is not None and cloud.intensities is not None:
        intensities = (cloud.intensities / max_intensity).clamp(0, 1)
    times = None if cloud.times is None else relative_times(cloud.times, shares_per_unit)
    return Scan(raise_beams(cloud.points, beam_correction_deg), times, intensities)


def note_returns(cloud: Cloud, name: str, index: int, empty: list[int]) -> None:
    """Note a scan without any return (a covered lens, a dead driver), and warn of the first one of a sequence.

    Args:
        cloud: as read from the file.
        name: of the sequence.
        index: of the scan.
        empty: indices of the scans noted before; is extended.
    """
    if len(cloud.points):
        return
    if not empty:
        _log.warning("%s: scan %d has not a single return, and counts as an empty one; others may follow", name, index)
    empty.append(index)


def relative_times(times: Float[Tensor, "n"], shares_per_unit: float | None = None) -> Float[Tensor, "n"]:
    """Times as shares of the scan period, relative to the middle of the sweep; 0 if all are the same.

    Args:
        times: in any unit.
        shares_per_unit: scan periods per unit; None if unknown: a sweep is assumed to last for one period.
    """
    if not len(times):
        return times.float()
    first, last = times.min(), times.max()
    if shares_per_unit is None:
        shares_per_unit = 1 / float(last - first) if last > first else 0.0
    return ((times - (first + last) / 2) * shares_per_unit).float()


def require_point_times(sequence: Sequence, where: str) -> None:
    """Raise UserError if the points of the first scan with a return have no times, or all the same.

    Args:
        sequence: to be deskewed.
        where: place of the scans, for the message.
    """
    scan = next((scan for scan in sequence if len(scan.points)), None)
    if scan is not None and (scan.times is None or not varied(scan.times)):
        raise UserError(f"{where}: no point times to deskew with, or all the same.\n  change: data.deskew=false")


def _columns(rows: NDArray[np.float32]) -> dict[str, NDArray[Any]]:
    return {name: rows[:, i] for i, name in enumerate(("x", "y", "z", "intensity")[: rows.shape[1]])}


def _read_npy(path: Path) -> dict[str, NDArray[Any]]:
    try:
        rows = np.load(path, allow_pickle=False)
    except (OSError, ValueError, EOFError) as error:
        raise DamagedFileError(path, f"no array of numbers ({error})") from error
    if rows.dtype.names is not None:
        return {name.lower(): rows[name].reshape(-1) for name in rows.dtype.names}
    if rows.ndim != 2 or rows.shape[1] < 3 or rows.dtype.kind not in "fiu":
        raise DamagedFileError(path, f"an array {rows.shape} of {rows.dtype}, not (n, 3 or more) numbers")
    if not np.isfinite(rows[:, :4]).all():
        raise DamagedFileError(path, "points that are not finite")
    return _columns(rows.astype(np.float32))
