import numpy as np
import pytest
import torch

from lidarlearn.data.errors import DamagedFileError, DataSetNotFoundError
from tests.data.datasets import data_set, findings
from tests.data.writers import write_newer_college

WALK = "01_short_experiment"


def newer_college(root, **settings):
    return data_set("newer_college", root, WALK, **settings)


def truth_file(root):
    return root / WALK / "ground_truth" / "registered_poses.csv"


def test_round_trip(tmp_path):
    written = write_newer_college(tmp_path)
    sequence = newer_college(tmp_path).sequence(WALK)
    assert len(sequence) == 4
    for scan, points in zip(sequence, written.points, strict=True):
        assert torch.equal(scan.points, torch.from_numpy(points))
        columns = np.arange(0, 65536, 300) // 64
        assert torch.allclose(scan.times, torch.from_numpy(columns / 1024 - 0.5).float())
    # Poses are half a sweep later than the stamps; with a constant twist the relative poses are those of the curve.
    assert np.allclose(sequence.T_world_lidar, written.T_world_lidar, atol=1e-5)
    assert np.allclose(sequence.timestamps - sequence.timestamps[0], 0.1 * np.arange(4), atol=1e-6)
    assert newer_college(tmp_path).deskew


def test_scan_with_missing_columns_has_no_times(tmp_path):
    write_newer_college(tmp_path)
    path = sorted((tmp_path / WALK / "raw_format" / "ouster_scan").iterdir())[0]
    content = path.read_bytes().replace(b"WIDTH 1024", b"WIDTH 1023").replace(b"POINTS 65536", b"POINTS 65472")
    path.write_bytes(content[: -64 * 12])
    assert any(scan.times is None for scan in newer_college(tmp_path).sequence(WALK))


def test_missing_ground_truth_is_reported(tmp_path):
    write_newer_college(tmp_path)
    truth_file(tmp_path).unlink()
    assert newer_college(tmp_path).sequence(WALK).T_world_lidar is None
    assert "no ground truth" in findings(newer_college(tmp_path).check(), "missing")


def test_scans_outside_ground_truth_are_dropped(tmp_path, caplog):
    write_newer_college(tmp_path)
    lines = truth_file(tmp_path).read_text().splitlines()
    truth_file(tmp_path).write_text("\n".join([lines[0], *lines[4:8]]) + "\n")
    assert len(newer_college(tmp_path).sequence(WALK)) == 2
    assert "2 scans before or after" in caplog.text


@pytest.mark.parametrize(
    ("content", "problem"),
    [
        ("", "empty"),
        ("#sec,nsec,x,y,z,qx,qy,qz,qw\n", "empty"),
        ("1,2,3\n", "3 numbers"),
        ("1,0,0,0,0,0,0,0,1\n", "at least two"),
        ("1,0,0,0,0,0,0,0,0\n2,0,0,0,0,0,0,0,1\n", "quaternion"),
        ("2,0,0,0,0,0,0,0,1\n1,0,0,0,0,0,0,0,1\n", "do not ascend"),
        ("1,0,nan,0,0,0,0,0,1\n2,0,0,0,0,0,0,0,1\n", "not finite"),
        ("1,0,0,0,0,0,0,0,1\n2,0,0,0,0,0,0,0,1\n", "do not overlap"),
    ],
)
def test_damaged_ground_truth_is_refused(tmp_path, content, problem):
    write_newer_college(tmp_path)
    truth_file(tmp_path).write_text(content)
    with pytest.raises(DamagedFileError, match=problem):
        newer_college(tmp_path).sequence(WALK)


def test_file_of_other_name_is_no_scan(tmp_path):
    write_newer_college(tmp_path)
    path = sorted((tmp_path / WALK / "raw_format" / "ouster_scan").iterdir())[0]
    path.rename(path.with_name("cloud.pcd"))
    assert len(newer_college(tmp_path).sequence(WALK)) == 3
    assert "'cloud.pcd'" in findings(newer_college(tmp_path).check(), "odd")


def test_missing_data_and_wrong_root_are_reported(tmp_path):
    with pytest.raises(DataSetNotFoundError, match="Newer College"):
        newer_college(tmp_path / "nowhere").sequence(WALK)
    write_newer_college(tmp_path)
    with pytest.raises(DataSetNotFoundError, match="wrong folder level"):
        newer_college(tmp_path / WALK).sequence(WALK)
