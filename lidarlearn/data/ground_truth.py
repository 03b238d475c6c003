"""Ground truth beside recordings that have no format of their own for it: poses of the LiDAR in KITTI's or TUM's."""

from pathlib import Path

from jaxtyping import Float
from torch import Tensor

from lidarlearn.data import layout
from lidarlearn.data.errors import DamagedFileError
from lidarlearn.data.interpolation import interpolate_poses
from lidarlearn.data.pose_files import read_kitti_poses, read_lines, read_tum_poses, start_at_identity
from lidarlearn.data.sequence import LayoutReport

_INSIDE = ("poses.txt", "poses.tum", "groundtruth.txt")
_BESIDE = (".txt", ".tum")


def find_ground_truth(recording: Path, name: str | None = None) -> Path | None:
    """The file with a recording's ground truth; None where there is none.

    Args:
        recording: a folder, in which it may lie, or a file.
        name: of the file beside the recording, without its suffix; None for the recording's own.
    """
    recording = recording.absolute()
    inside = [recording / file for file in _INSIDE]
    beside = [recording.with_name(f"{name or recording.name}{suffix}") for suffix in _BESIDE]
    return next((path for path in inside + beside if path.is_file()), None)


def read_ground_truth(path: Path, count: int, timestamps: Float[Tensor, "n"] | None) -> Float[Tensor, "m 4 4"]:
    """A pose for every scan, the first one the identity.

    KITTI's rows belong to the scans in order; TUM's are interpolated at the scans' times, or belong to the scans in
    order where these have no times.

    Args:
        path: of the file.
        count: number of scans.
        timestamps: of the scans [s]; None where there are none.

    Raises:
        DamagedFileError: no such file, another number of poses than scans, or none at the times of some.
    """
    columns = len(next(iter(read_lines(path)), "").split())
    if columns == 12:
        T_world = read_kitti_poses(path)
    else:
        stamped = read_tum_poses(path)
        T_world = stamped.T_world_body
        if timestamps is not None:
            return start_at_identity(_at(path, stamped.timestamps, T_world, timestamps))
    if len(T_world) != count:
        raise DamagedFileError(path, f"{len(T_world)} poses for {count} scans", "give every scan a row or a time")
    return start_at_identity(T_world)


def describe_ground_truth(report: LayoutReport, name: str, path: Path | None) -> None:
    """Note a recording's ground truth, or that there is none."""
    if path is None:
        report.odd(name, "no ground truth: errors will not be defined, and the supervised loss cannot be used")
    else:
        report.found(name, f"ground truth in {path} with {layout.count_rows(path)} rows")


def _at(
    path: Path, times: Float[Tensor, "n"], T_world: Float[Tensor, "n 4 4"], scan_times: Float[Tensor, "m"]
) -> Float[Tensor, "m 4 4"]:
    """Poses at the scans' times; the nearest pose may be a tenth of a second beyond an end."""
    if len(times) < 2 or scan_times.min() < times[0] - 0.1 or scan_times.max() > times[-1] + 0.1:
        raise DamagedFileError(
            path,
            f"its times ({times[0]:.3f} to {times[-1]:.3f} s) do not cover those of the scans "
            f"({scan_times.min():.3f} to {scan_times.max():.3f} s)",
            "use one clock in both files",
        )
    return interpolate_poses(times, T_world, scan_times)
