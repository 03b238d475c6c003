"""Which module writes which data set."""

from collections.abc import Callable
from typing import Any

from lidarlearn.data.export.folder import write_folder
from lidarlearn.data.export.ford_campus import write_ford_campus
from lidarlearn.data.export.kitti import write_kitti_odometry
from lidarlearn.data.export.kitti_360 import write_kitti_360
from lidarlearn.data.export.kitti_raw import write_kitti_raw
from lidarlearn.data.export.nclt import write_nclt
from lidarlearn.data.export.newer_college import write_newer_college
from lidarlearn.data.folder import Folder
from lidarlearn.data.ford_campus import FordCampus
from lidarlearn.data.kitti import KittiOdometry
from lidarlearn.data.kitti_360 import Kitti360
from lidarlearn.data.kitti_raw import KittiRaw
from lidarlearn.data.nclt import Nclt
from lidarlearn.data.newer_college import NewerCollege
from lidarlearn.data.sequence import DataSet, Sequence
from lidarlearn.errors import UserError

_WRITERS: dict[type[DataSet], Callable[..., None]] = {
    KittiOdometry: write_kitti_odometry,
    KittiRaw: write_kitti_raw,
    Kitti360: write_kitti_360,
    FordCampus: write_ford_campus,
    Nclt: write_nclt,
    NewerCollege: write_newer_college,
    Folder: write_folder,
}


def export(drive: Sequence, target: DataSet, name: str, **settings: Any) -> None:
    """Write a drive so that `target.sequence(name)` reads it back: same points, times, intensities and poses.

    The target's settings are undone on the way: where its reader raises every beam by 0.205 deg, the beams are written
    0.205 deg too low, as KITTI's are.

    Args:
        drive: what is written.
        target: the data set, with its root, in whose format it is written.
        name: of the sequence there.
        settings: of the format, such as `suffix` of a folder of scans.

    Raises:
        UserError: the format cannot hold such a drive.
    """
    writer = _WRITERS.get(type(target))
    if writer is None:
        raise UserError(f"{target.title} cannot be written.\n  change: to={'|'.join(c.__name__ for c in _WRITERS)}")
    writer(drive, target, name, **settings)
