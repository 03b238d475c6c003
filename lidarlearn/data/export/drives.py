"""What all formats ask of a drive."""

from collections.abc import Iterator
from pathlib import Path

import torch
from jaxtyping import Float
from torch import Tensor

from lidarlearn.data.kitti_raw import sweep_times
from lidarlearn.data.sequence import Scan, Sequence
from lidarlearn.errors import UserError
from lidarlearn.progress import tracked

PERIOD_S = 0.1
_SWEEP_TOLERANCE = 0.01  # of a revolution


def write_shared(path: Path, text: str) -> None:
    """Write a file that all sequences of a copy share.

    Raises:
        UserError: it is there already, and says something else.
    """
    if path.is_file() and path.read_bytes() != text.encode():
        raise UserError(
            f"{path.absolute()} belongs to other sequences, and is not written over.\n"
            "  change: to.root=/an/empty/folder"
        )
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(text, encoding="utf-8")


def scans_of(drive: Sequence, name: str) -> Iterator[Scan]:
    """All scans, with their progress shown; an empty one as a point at the origin, which stands for no return."""
    return tracked(map(_with_a_point, drive), f"writing sequence {name}", len(drive))


def timestamps_of(drive: Sequence) -> Float[Tensor, "n"]:
    """Seconds of each scan; ten scans a second where the drive has no times."""
    return PERIOD_S * torch.arange(len(drive), dtype=torch.float64) if drive.timestamps is None else drive.timestamps


def period_of(drive: Sequence) -> float:
    """Seconds from scan to scan."""
    return float(timestamps_of(drive).diff().median()) if len(drive) > 1 else PERIOD_S


def ground_truth_of(drive: Sequence, format_name: str) -> Float[Tensor, "n 4 4"]:
    """The poses, for formats that cannot do without.

    Raises:
        UserError: the drive has none.
    """
    if drive.T_world_lidar is None:
        raise UserError(
            f"{format_name} holds a pose for every scan, but {drive.name} has no ground truth."
            "\n  change: to=folder, or export a drive with ground truth"
        )
    return drive.T_world_lidar


def require_compensated(drive: Sequence, format_name: str) -> None:
    """Raise UserError where scans are distorted by motion and the format holds scans that are not."""
    if drive.first_returns().times is not None:
        raise UserError(
            f"{format_name} holds motion-compensated scans, but those of {drive.name} are distorted by motion."
            "\n  change: data.motion_distortion=false for simulated drives, or to=kitti_raw, kitti_360 or folder"
        )


def require_sweeps(drive: Sequence, format_name: str) -> None:
    """Raise UserError unless each point's azimuth tells its time, as the format's readers take it to do."""
    scan = drive.first_returns()
    if scan.times is None:
        raise UserError(
            f"{format_name} holds scans as the motion distorted them, but those of {drive.name} are compensated."
            "\n  change: data.motion_distortion=true for simulated drives, or to=kitti_00-08"
        )
    difference = (scan.times - sweep_times(scan.points) + 0.5) % 1 - 0.5
    if difference.abs().max() > _SWEEP_TOLERANCE:
        raise UserError(
            f"{format_name} tells a point's time by its azimuth, clockwise from the rear; the times of {drive.name}"
            f" differ from that by up to {difference.abs().max():.2f} sweeps.\n  change: to=folder, which holds times"
        )


def _with_a_point(scan: Scan) -> Scan:
    """The scan, or where it is empty one point at the origin: a file without points would pass for a damaged one."""
    if len(scan.points):
        return scan
    times, intensities = (None if part is None else torch.zeros(1) for part in (scan.times, scan.intensities))
    return Scan(torch.zeros(1, 3), times, intensities)
