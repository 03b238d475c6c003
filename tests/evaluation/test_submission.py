"""Submissions to KITTI's test server."""

import zipfile

from lidarlearn.data.pose_files import write_kitti_poses
from lidarlearn.evaluation.run import Export
from lidarlearn.evaluation.submission import KITTI_TEST_FRAMES, is_kitti_test_set, write_submission
from tests.evaluation.conftest import DriveWithoutScans


def _test_set(T_camera_lidar, **changed):
    frames = KITTI_TEST_FRAMES | changed
    return [DriveWithoutScans(name, None, count, None, T_camera_lidar) for name, count in frames.items()]


def test_submission_needs_all_eleven_whole_sequences(T_camera_lidar):
    assert is_kitti_test_set(_test_set(T_camera_lidar))
    assert not is_kitti_test_set(_test_set(T_camera_lidar)[1:])
    assert not is_kitti_test_set(_test_set(T_camera_lidar, **{"19": 100}))
    assert not is_kitti_test_set([DriveWithoutScans(name, None, n) for name, n in KITTI_TEST_FRAMES.items()])


def test_submission_zip_holds_pose_files(tmp_path, make_drive):
    for name in KITTI_TEST_FRAMES:
        write_kitti_poses(Export(tmp_path / "cv+p_f2m", name).kitti, make_drive(7))
    with zipfile.ZipFile(write_submission(tmp_path / "submission.zip", tmp_path / "cv+p_f2m")) as archive:
        assert archive.namelist() == [f"{i}.txt" for i in range(11, 22)]
        rows = archive.read("15.txt").decode().splitlines()
    assert len(rows) == 7 and all(len(row.split()) == 12 for row in rows)


def test_kitti_frame_counts_add_up_to_43552():
    from lidarlearn.evaluation.published import KITTI_FRAMES

    assert sum(KITTI_FRAMES.values()) + sum(KITTI_TEST_FRAMES.values()) == 43552
