"""Which exporter writes which data set."""

from typing import Any

from lidarlearn.data.cloud_files import SUFFIXES
from lidarlearn.data.export.exporter import Exporter
from lidarlearn.data.export.folder import FolderExporter
from lidarlearn.data.export.ford_campus import FordCampusExporter
from lidarlearn.data.export.kitti import KittiOdometryExporter
from lidarlearn.data.export.kitti_360 import Kitti360Exporter
from lidarlearn.data.export.kitti_raw import KittiRawExporter
from lidarlearn.data.export.nclt import NcltExporter
from lidarlearn.data.export.newer_college import NewerCollegeExporter
from lidarlearn.data.folder import Folder
from lidarlearn.data.ford_campus import FordCampus
from lidarlearn.data.kitti import KittiOdometry
from lidarlearn.data.kitti_360 import Kitti360
from lidarlearn.data.kitti_raw import KittiRaw
from lidarlearn.data.nclt import Nclt
from lidarlearn.data.newer_college import NewerCollege
from lidarlearn.data.sequence import DataSet
from lidarlearn.errors import UserError

_EXPORTERS: dict[type[DataSet], type[Exporter[Any]]] = {
    KittiOdometry: KittiOdometryExporter,
    KittiRaw: KittiRawExporter,
    Kitti360: Kitti360Exporter,
    FordCampus: FordCampusExporter,
    Nclt: NcltExporter,
    NewerCollege: NewerCollegeExporter,
    Folder: FolderExporter,
}


def exporter_of(target: DataSet, suffix: str | None = None) -> Exporter[Any]:
    """The exporter that writes a data set.

    Args:
        target: the data set, with the root to write to.
        suffix: of the scans of a plain folder: .bin, .npy, .pcd or .ply; None for .pcd.

    Raises:
        UserError: the data set cannot be written, or its scans cannot have that suffix.
    """
    exporter = _EXPORTERS.get(type(target))
    if exporter is None:
        options = "|".join(known.option for known in _EXPORTERS.values())
        raise UserError(f"{target.title}: this data set cannot be written.\n  change: to={options}")
    if suffix is None:
        return exporter(target)
    if not isinstance(target, Folder):
        raise UserError(f"{target.title} has its own kind of files.\n  change: leave out suffix={suffix}, or to=folder")
    if suffix not in SUFFIXES:
        raise UserError(f"scans cannot be written as {suffix!r}.\n  change: suffix={'|'.join(SUFFIXES)}")
    return FolderExporter(target, suffix)
