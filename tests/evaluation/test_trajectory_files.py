import numpy as np
import pytest
import torch
from evo.tools import file_interface

from lidarlearn.data.pose_files import write_kitti_poses, write_tum_poses
from lidarlearn.errors import UserError
from lidarlearn.evaluation.trajectory_files import (
    TrajectoryError,
    find_trajectories,
    lidar_poses,
    read_trajectory,
    to_lidar_frame,
    to_reference_frame,
)

TIMES = 1.3e9 + 0.1 * torch.arange(30, dtype=torch.float64)


@pytest.fixture
def poses(make_drive):
    T = make_drive(30)
    T[:, :3, 3] *= 1234.5678901
    return T


def write(tmp_path, text):
    path = tmp_path / "a.txt"
    path.write_text(text)
    return path


def test_kitti_file_round_trip(tmp_path, poses):
    write_kitti_poses(tmp_path / "new" / "00.txt", poses)
    assert torch.allclose(read_trajectory(tmp_path / "new" / "00.txt"), poses, rtol=1e-12, atol=1e-12)


def test_kitti_file_has_nine_digits_and_evo_reads_it(tmp_path, poses):
    path = tmp_path / "00.txt"
    write_kitti_poses(path, poses)
    words = path.read_text().split()
    assert len(words) == 12 * 30
    assert all(len(word.split("e")[0].strip("-").replace(".", "")) >= 9 for word in words)
    np.testing.assert_allclose(file_interface.read_kitti_poses_file(str(path)).poses_se3, poses.numpy(), rtol=1e-9)


def test_tum_file_round_trip_and_evo_reads_it(tmp_path, poses):
    path = tmp_path / "00.tum"
    write_tum_poses(path, poses, TIMES)
    assert torch.allclose(read_trajectory(path, TIMES), poses, rtol=1e-10, atol=1e-10)
    evo = file_interface.read_tum_trajectory_file(str(path))
    np.testing.assert_allclose(evo.poses_se3, poses.numpy(), rtol=1e-9, atol=1e-9)
    np.testing.assert_allclose(evo.timestamps, TIMES.numpy(), rtol=0, atol=1e-6)


def test_tum_file_without_times_counts_frames(tmp_path, poses):
    path = tmp_path / "00.tum"
    write_tum_poses(path, poses, None)
    assert torch.allclose(read_trajectory(path), poses, rtol=1e-10, atol=1e-10)
    assert np.loadtxt(path)[:, 0].tolist() == list(range(30))


def test_paths_may_be_strings(tmp_path, poses):
    write_kitti_poses(f"{tmp_path}/new/00.txt", poses)
    write_tum_poses(f"{tmp_path}/newer/00.tum", poses, TIMES)
    for path in (tmp_path / "new" / "00.txt", tmp_path / "newer" / "00.tum"):
        assert torch.allclose(read_trajectory(path), poses, rtol=1e-10, atol=1e-10)


def test_scans_take_nearest_tum_pose(tmp_path, poses):
    path = tmp_path / "00.tum"
    write_tum_poses(path, poses, TIMES)
    scans = TIMES[[3, 8, 29]] + torch.tensor([0.004, -0.004, 0.009], dtype=torch.float64)
    assert torch.allclose(read_trajectory(path, scans), poses[[3, 8, 29]], rtol=1e-10, atol=1e-10)


@pytest.mark.parametrize("shift", [0.05, -0.05, 3600.0, -1.3e9])
def test_scans_without_close_tum_pose_are_refused(tmp_path, poses, shift):
    path = tmp_path / "00.tum"
    write_tum_poses(path, poses, TIMES)
    with pytest.raises(TrajectoryError, match=r"30 of 30 scans have no pose within 0.01 s, the first is scan 0"):
        read_trajectory(path, TIMES + shift)


def test_missing_tum_pose_is_named(tmp_path, poses):
    path = tmp_path / "00.tum"
    kept = [i for i in range(30) if i != 17]
    write_tum_poses(path, poses[kept], TIMES[kept])
    with pytest.raises(TrajectoryError, match=r"1 of 30 scans have no pose within 0.01 s, the first is scan 17"):
        read_trajectory(path, TIMES)


IDENTITY_ROW = "1 0 0 0 0 1 0 0 0 0 1 0\n"


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "0 numbers"),
        ("# only a comment\n\n", "0 numbers"),
        ("1 2 3\n", "3 numbers"),
        ("0 " + IDENTITY_ROW, "13 numbers"),
        (IDENTITY_ROW + "1 0 0 0 0 1 0 0 0 0 1\n", "11"),
        (IDENTITY_ROW + "1 0 0 0 0 one 0 0 0 0 1 0\n", "one"),
        (IDENTITY_ROW + IDENTITY_ROW.replace("1 0\n", "1 nan\n"), "row 2"),
        (IDENTITY_ROW + "1 0 0 0 0 2 0 0 0 0 1 0\n", "row 2 is not a rotation"),
        (IDENTITY_ROW + "1 0 0 0 0 1 0 0 0 0 -1 0\n", "row 2 is not a rotation"),
        ("1 0 0 0 1 0 0 0 1 0 0 0\n", "row 1 is not a rotation"),  # rotation first, then translation
        ("0 1 2 3 0 0 0 0\n", "quaternion"),
        ("0 1 2 3 0 0 0 1\n0 1 2 3 0 0 0 1\n", "ascend"),
    ],
)
def test_malformed_file_error_quotes_content(tmp_path, text, message):
    path = write(tmp_path, text)
    with pytest.raises(UserError) as caught:
        read_trajectory(path)
    assert message in str(caught.value)
    assert str(path) in str(caught.value)
    assert "change:" in str(caught.value)


def test_missing_file_is_named(tmp_path):
    with pytest.raises(TrajectoryError, match=r"no.txt: no such trajectory"):
        read_trajectory(tmp_path / "no.txt")


def test_camera_and_lidar_frame_round_trip(poses, make_sequence, T_camera_lidar):
    sequence = make_sequence("04", len(poses), T_camera_lidar)
    T_world_camera = to_reference_frame(poses, T_camera_lidar)
    forward = T_world_camera[1, :3, 3]
    assert forward[2] > 0.9 * forward.norm()  # the camera looks along z
    back = to_lidar_frame(T_world_camera, "camera", sequence)
    assert torch.allclose(back, poses, atol=1e-10)
    assert to_lidar_frame(poses, "lidar", sequence) is poses


@pytest.mark.parametrize("frame", ["camera", "imu"])
def test_unknown_frame_is_refused(poses, make_sequence, frame):
    with pytest.raises(TrajectoryError, match=f"frame '{frame}'.* lidar"):
        to_lidar_frame(poses, frame, make_sequence("04", len(poses)))


def test_poses_that_fit_better_in_lidar_frame_are_refused(make_sequence, T_camera_lidar, tmp_path):
    sequence = make_sequence("04", 20, T_camera_lidar)
    as_lidar, as_camera = sequence.T_world_lidar, to_reference_frame(sequence.T_world_lidar, T_camera_lidar)
    torch.testing.assert_close(lidar_poses(as_camera, None, sequence, tmp_path / "04.txt"), as_lidar)
    assert lidar_poses(as_lidar, "lidar", sequence, tmp_path / "04.txt") is as_lidar
    with pytest.raises(TrajectoryError, match="trajectories_frame=lidar"):
        lidar_poses(as_lidar, None, sequence, tmp_path / "04.txt")
    lidar_poses(as_lidar, "camera", sequence, tmp_path / "04.txt")  # an explicit frame is not questioned
    lidar_poses(as_lidar[:5], None, sequence, tmp_path / "04.txt")  # the number of poses is checked elsewhere


def touch(folder, *names):
    folder.mkdir(parents=True, exist_ok=True)
    for name in names:
        (folder / name).write_text(IDENTITY_ROW)


def test_find_trajectories_in_folder_of_one_method(tmp_path):
    touch(tmp_path / "suma", "09.txt", "10.tum", "10.txt", "notes.md")
    found = find_trajectories(tmp_path / "suma", ["09", "10"])
    assert found == {"suma": {"09": tmp_path / "suma" / "09.txt", "10": tmp_path / "suma" / "10.txt"}}


def test_find_trajectories_in_folders_of_several_methods(tmp_path):
    touch(tmp_path / "cv+p_f2m", "09.tum")
    touch(tmp_path / "posenet", "09.txt", "10.txt")
    touch(tmp_path / "plots", "a.png")
    found = find_trajectories(tmp_path, ["09"])
    assert {method: files["09"].name for method, files in found.items()} == {"cv+p_f2m": "09.tum", "posenet": "09.txt"}


def test_find_trajectories_in_run_folder(tmp_path):
    touch(tmp_path / "trajectories" / "cv+kd_f2m", "00.txt", "00.tum", "00.health.csv")
    touch(tmp_path / "plots", "trajectories_00.png")
    assert find_trajectories(tmp_path, ["00"]) == {"cv+kd_f2m": {"00": tmp_path / "trajectories/cv+kd_f2m/00.txt"}}


def test_find_trajectories_of_single_file(tmp_path):
    touch(tmp_path / "loam", "09.txt", "loam_on_09.txt")
    assert list(find_trajectories(tmp_path / "loam" / "09.txt", ["09"])) == ["loam"]
    assert list(find_trajectories(tmp_path / "loam" / "loam_on_09.txt", ["09"])) == ["loam_on_09"]


def test_find_trajectories_reports_missing_files(tmp_path):
    touch(tmp_path / "suma", "09.txt", "notes.md")
    with pytest.raises(TrajectoryError, match="'suma' has no trajectory for 10"):
        find_trajectories(tmp_path / "suma", ["09", "10"])
    with pytest.raises(TrajectoryError, match=r"there is: 09\.txt, notes\.md"):
        find_trajectories(tmp_path / "suma", ["00"])
    with pytest.raises(TrajectoryError, match="no such file or folder"):
        find_trajectories(tmp_path / "nowhere", ["09"])
    with pytest.raises(TrajectoryError, match="one trajectory for 2 sequences"):
        find_trajectories(tmp_path / "suma" / "09.txt", ["09", "10"])
