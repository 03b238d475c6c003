import numpy as np
import pytest
import torch

from lidarlearn.data.errors import DamagedFileError, DataSetNotFoundError
from tests.data.datasets import data_set, findings
from tests.data.writers import relative_to_first, write_kitti_360

DRIVE = "2013_05_28_drive_0003_sync"


def kitti_360(root, **settings):
    return data_set("kitti_360", root, "0003", **settings)


def poses_file(root):
    return root / "data_poses" / DRIVE / "poses.txt"


def test_round_trip(tmp_path):
    written = write_kitti_360(tmp_path)
    sequence = kitti_360(tmp_path).sequence("0003")
    assert len(sequence) == 6 and sequence.reference_frame == "lidar"
    for scan, points in zip(sequence, written.points, strict=True):
        assert torch.equal(scan.points, torch.from_numpy(points))
        assert scan.times is not None and scan.times.abs().max() <= 0.5
        assert scan.intensities is not None and (scan.intensities == 0.5).all()
    assert np.allclose(sequence.T_world_lidar, written.T_world_lidar, atol=1e-6)
    assert np.allclose(sequence.timestamps.diff(), 0.1, atol=1e-6)
    assert kitti_360(tmp_path).deskew


def test_missing_poses_are_interpolated(tmp_path):
    written = write_kitti_360(tmp_path, without_pose=(2, 3))
    sequence = kitti_360(tmp_path).sequence("0003")
    assert np.allclose(sequence.T_world_lidar, written.T_world_lidar, atol=1e-6)


def test_scans_outside_ground_truth_are_dropped(tmp_path, caplog):
    written = write_kitti_360(tmp_path, without_pose=(0, 5))
    sequence = kitti_360(tmp_path).sequence("0003")
    assert len(sequence) == 4 and "2 scans before or after" in caplog.text
    assert np.allclose(sequence.T_world_lidar, relative_to_first(written.T_world_lidar[1:5]), atol=1e-6)
    assert torch.equal(sequence.scan(0).points, torch.from_numpy(written.points[1]))


def test_missing_ground_truth_is_reported(tmp_path):
    write_kitti_360(tmp_path)
    poses_file(tmp_path).unlink()
    sequence = kitti_360(tmp_path).sequence("0003")
    assert sequence.T_world_lidar is None and len(sequence) == 6
    assert "no ground truth" in findings(kitti_360(tmp_path).check(), "missing")


@pytest.mark.parametrize(
    ("content", "problem"),
    [
        ("", "empty"),
        ("1 2 3\n", "3 numbers"),
        ("0 " + "nan " * 12 + "\n1 " + "1 " * 12, "not finite"),
        ("1 " + "1 " * 12 + "\n0 " + "1 " * 12, "do not ascend"),
        ("0 " + "1 " * 12 + "\n99 " + "1 " * 12, "too few for frame 99"),
        ("3 " + "1 " * 12 + "\n", "at least two"),
    ],
)
def test_damaged_poses_are_refused(tmp_path, content, problem):
    write_kitti_360(tmp_path)
    poses_file(tmp_path).write_text(content)
    with pytest.raises(DamagedFileError, match=problem):
        kitti_360(tmp_path).sequence("0003")


def test_damaged_calibration_is_refused(tmp_path):
    write_kitti_360(tmp_path)
    (tmp_path / "calibration" / "calib_cam_to_pose.txt").write_text("image_02: 1 2 3\n")
    with pytest.raises(DamagedFileError, match="image_00"):
        kitti_360(tmp_path).sequence("0003")


def test_truncated_scan_is_reported(tmp_path):
    write_kitti_360(tmp_path)
    path = tmp_path / "data_3d_raw" / DRIVE / "velodyne_points" / "data" / "0000000002.bin"
    path.write_bytes(path.read_bytes()[:-3])
    with pytest.raises(DamagedFileError, match="truncated"):
        kitti_360(tmp_path).sequence("0003").scan(2)
    assert "truncated" in findings(kitti_360(tmp_path).check(), "missing")


def test_missing_parts_are_reported(tmp_path):
    with pytest.raises(DataSetNotFoundError, match="KITTI-360"):
        kitti_360(tmp_path / "nowhere").sequence("0003")
    write_kitti_360(tmp_path)
    with pytest.raises(DataSetNotFoundError, match="wrong folder level"):
        kitti_360(tmp_path / "data_3d_raw").sequence("0003")
    (tmp_path / "calibration" / "calib_cam_to_velo.txt").unlink()
    with pytest.raises(DataSetNotFoundError, match="calib_cam_to_velo"):
        kitti_360(tmp_path).sequence("0003")
    assert "calib_cam_to_velo" in findings(kitti_360(tmp_path).check(), "missing")
