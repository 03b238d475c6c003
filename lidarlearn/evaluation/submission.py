"""Files for the test server of the KITTI odometry benchmark."""

import zipfile
from collections.abc import Iterable
from pathlib import Path

from lidarlearn.data.sequence import Sequence
from lidarlearn.evaluation.run import Export

# Number of scans in each sequence of the KITTI odometry benchmark whose ground truth only the server has.
KITTI_TEST_FRAMES = {
    "11": 921,
    "12": 1061,
    "13": 3281,
    "14": 631,
    "15": 1901,
    "16": 1731,
    "17": 491,
    "18": 1801,
    "19": 4981,
    "20": 831,
    "21": 2721,
}


def is_kitti_test_set(sequences: Iterable[Sequence]) -> bool:
    """Whether the sequences include all of 11 to 21, whole and with poses of the left camera."""
    frames = {sequence.name: len(sequence) for sequence in sequences if sequence.reference_frame == "camera"}
    return KITTI_TEST_FRAMES.items() <= frames.items()


def write_submission(path: Path, trajectories: Path) -> Path:
    """Pack 11.txt to 21.txt, with one pose of the left camera per row, into a zip file without folders.

    Args:
        path: the zip file to write.
        trajectories: a method's folder of exported trajectories.

    Returns:
        The zip file.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
        for name in KITTI_TEST_FRAMES:
            archive.write(Export(trajectories, name).kitti, f"{name}.txt")
    return path
