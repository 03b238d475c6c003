"""Which module writes which data set, and where."""

import glob
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

from lidarlearn.data.cloud_files import SUFFIXES
from lidarlearn.data.export.folder import require_folder, write_folder
from lidarlearn.data.export.ford_campus import require_ford_campus, write_ford_campus
from lidarlearn.data.export.kitti import require_kitti_odometry, write_kitti_odometry
from lidarlearn.data.export.kitti_360 import require_kitti_360, write_kitti_360
from lidarlearn.data.export.kitti_raw import require_kitti_raw, write_kitti_raw
from lidarlearn.data.export.nclt import require_nclt, write_nclt
from lidarlearn.data.export.newer_college import require_newer_college, write_newer_college
from lidarlearn.data.folder import Folder
from lidarlearn.data.ford_campus import FordCampus
from lidarlearn.data.kitti import KittiOdometry
from lidarlearn.data.kitti_360 import Kitti360
from lidarlearn.data.kitti_raw import KittiRaw
from lidarlearn.data.nclt import Nclt
from lidarlearn.data.newer_college import NewerCollege
from lidarlearn.data.sequence import DataSet, Sequence
from lidarlearn.data.writable import writable
from lidarlearn.errors import UserError

_REMEDY = "to.root=/an/empty/folder"


@dataclass(frozen=True)
class Format:
    """How a data set is written.

    Args:
        option: a choice of `to=` on the command line that is written so.
        require: raises UserError where the format cannot hold a drive; takes what `write` does.
        write: takes a drive, the target and the sequence's name there.
        places: below the root, what belongs to a sequence alone; `{}` stands for its name, `*` for anything.
    """

    option: str
    require: Callable[[Sequence, Any, str], None]
    write: Callable[[Sequence, Any, str], None]
    places: tuple[str, ...] = ("{}",)


_FORMATS: dict[type[DataSet], Format] = {
    KittiOdometry: Format(
        "kitti_00-08", require_kitti_odometry, write_kitti_odometry, ("sequences/{}", "poses/{}.txt")
    ),
    KittiRaw: Format("kitti_raw", require_kitti_raw, write_kitti_raw, ("*/{}_sync",)),
    Kitti360: Format("kitti_360", require_kitti_360, write_kitti_360, ("data_*/*_drive_{}_sync",)),
    FordCampus: Format("ford_campus", require_ford_campus, write_ford_campus),
    Nclt: Format("nclt", require_nclt, write_nclt, ("{}", "ground_truth/groundtruth_{}.csv")),
    NewerCollege: Format("newer_college", require_newer_college, write_newer_college),
    Folder: Format("folder", require_folder, write_folder, ("{}", "{}.txt", "{}.tum")),
}


def export(drive: Sequence, target: DataSet, name: str, suffix: str | None = None) -> None:
    """Write a drive so that `target.sequence(name)` reads it back: same points, times, intensities and poses.

    The target's settings are undone on the way: where its reader raises every beam by 0.205 deg, the beams are written
    0.205 deg too low, as KITTI's are.

    Args:
        drive: what is written.
        target: the data set, with its root, in whose format it is written.
        name: of the sequence there.
        suffix: of the scans of a plain folder: .bin, .npy, .pcd or .ply; None for .pcd.

    Raises:
        UserError: the format cannot hold such a drive, or there is such a sequence already.
    """
    form = format_of(target, suffix)
    form.require(drive, target, name)
    require_new(target, name)
    writable(target.root, _REMEDY)
    form.write(drive, target, name)


def format_of(target: DataSet, suffix: str | None = None) -> Format:
    """How a data set is written.

    Raises:
        UserError: it cannot be, or its scans cannot have that suffix.
    """
    form = _FORMATS.get(type(target))
    if form is None:
        options = "|".join(form.option for form in _FORMATS.values())
        raise UserError(f"{target.title}: this data set cannot be written.\n  change: to={options}")
    if suffix is not None and not isinstance(target, Folder):
        raise UserError(f"{target.title} has its own kind of files.\n  change: leave out suffix={suffix}, or to=folder")
    if suffix is not None and suffix not in SUFFIXES:
        raise UserError(f"scans cannot be written as {suffix!r}.\n  change: suffix={'|'.join(SUFFIXES)}")
    if suffix is None:
        return form
    return replace(form, require=partial(require_folder, suffix=suffix), write=partial(write_folder, suffix=suffix))


def require_new(target: DataSet, name: str) -> None:
    """Raise UserError where anything of the sequence that is to be written is there already."""
    for place in format_of(target).places:
        for path in target.root.glob(place.format(glob.escape(name.removesuffix("_sync")))):
            raise UserError(
                f"{path.absolute()} is there already, and is not written over.\n  change: {_REMEDY}, or move it away"
            )
