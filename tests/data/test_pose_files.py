import numpy as np
import pytest
import torch

from lidarlearn.data.errors import DamagedFileError
from lidarlearn.data.interpolation import interpolate_poses
from lidarlearn.data.pose_files import read_kitti_poses, read_times, read_tum_poses, start_at_identity
from tests.data.writers import curve, kitti_rows, tum_rows


def test_kitti_round_trip(tmp_path):
    (tmp_path / "00.txt").write_text(kitti_rows(curve(4)))
    assert np.allclose(read_kitti_poses(tmp_path / "00.txt"), curve(4), atol=1e-11)


def test_tum_round_trip(tmp_path):
    (tmp_path / "00.txt").write_text(tum_rows(curve(4), [1.0, 1.5, 2.0, 2.5]))
    stamped = read_tum_poses(tmp_path / "00.txt")
    assert np.allclose(stamped.T_world_body, curve(4), atol=1e-10)
    assert stamped.timestamps.tolist() == [1.0, 1.5, 2.0, 2.5]


@pytest.mark.parametrize(
    ("content", "problem"),
    [
        ("0\n# a blank, and a comment\n\n0.1\nnan\n", "1 rows are not finite, the first is row 3"),
        ("0\n0.1\n0.1\n0.2\n", r"do not ascend, the first is in row 3(.|\n)*after that of the row before"),
        ("0\n0.2\n0.1\n0.3\n", "do not ascend, the first is in row 3"),
    ],
)
def test_damaged_times_are_refused(tmp_path, content, problem):
    (tmp_path / "times.txt").write_text(content)
    with pytest.raises(DamagedFileError, match=problem):
        read_times(tmp_path / "times.txt")


def test_byte_order_mark_is_skipped(tmp_path):
    """As written by editors on Windows."""
    (tmp_path / "times.txt").write_text("0.5\n1\n", encoding="utf-8-sig")
    assert read_times(tmp_path / "times.txt").tolist() == [0.5, 1]


@pytest.mark.parametrize(
    ("content", "problem"),
    [
        ("", "empty"),
        ("1 2 3\n", "3 numbers"),
        ("a b c\n", "not a table"),
        (kitti_rows(curve(2)) + "1 2 3\n", "not a table"),
        (kitti_rows(curve(2)) + " ".join(["nan"] * 12) + "\n", "the first is row 3"),
    ],
)
def test_damaged_kitti_poses_are_refused(tmp_path, content, problem):
    (tmp_path / "00.txt").write_text(content)
    with pytest.raises(DamagedFileError, match=problem):
        read_kitti_poses(tmp_path / "00.txt")


@pytest.mark.parametrize(
    ("content", "problem"),
    [
        (tum_rows(curve(3), [1.0, 3.0, 2.0]), "ascend, the first is in row 3"),
        ("1 0 0 0 0 0 0 0\n2 0 0 0 0 0 0 1\n", "quaternion"),
    ],
)
def test_damaged_tum_poses_are_refused(tmp_path, content, problem):
    (tmp_path / "00.txt").write_text(content)
    with pytest.raises(DamagedFileError, match=problem):
        read_tum_poses(tmp_path / "00.txt")


def test_start_at_identity_keeps_relative_poses():
    poses = torch.from_numpy(curve(5))
    moved = start_at_identity(poses[2:])
    assert torch.equal(moved[0], torch.eye(4).double())
    assert torch.allclose(moved[1], torch.linalg.inv(poses[2]) @ poses[3])


def test_interpolation_is_exact_for_constant_twist():
    poses, fine = torch.from_numpy(curve(4)), curve(2)
    times = torch.tensor([10.0, 10.1, 10.2, 10.3], dtype=torch.float64)
    half = torch.tensor([10.05, 10.15, 10.3, 10.35, 9.95], dtype=torch.float64)
    at_half = interpolate_poses(times, poses, half)
    step = torch.from_numpy(fine[1])
    for before, T in ((0, at_half[0]), (1, at_half[1]), (3, at_half[3])):
        half_step = torch.linalg.inv(poses[before]) @ T
        assert torch.allclose(half_step @ half_step, step, atol=1e-9)
    assert torch.allclose(at_half[2], poses[3], atol=1e-9)
    assert torch.allclose(torch.linalg.inv(at_half[4]) @ at_half[0], step, atol=1e-9)
