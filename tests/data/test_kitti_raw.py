import numpy as np
import pytest
import torch

from lidarlearn.data import kitti_raw
from lidarlearn.data.errors import DamagedFileError, DataSetNotFoundError
from lidarlearn.data.kitti_raw import ODOMETRY_DRIVES, sweep_times
from lidarlearn.data.oxts import mercator, read_oxts_poses
from lidarlearn.geometry import se3
from lidarlearn.geometry.voxels import grid_sample
from lidarlearn.odometry.deskew import deskew
from lidarlearn.registration.association.kdtree import KdTree
from lidarlearn.registration.gauss_newton import GaussNewton
from tests.data.datasets import data_set, findings
from tests.data.writers import write_kitti_raw

DRIVE = "2011_09_26_drive_0009"


def raw(root, name=DRIVE, **settings):
    return data_set("kitti_raw", root, name, **settings)


def folder(root):
    return root / "2011_09_26" / f"{DRIVE}_sync"


def test_round_trip(tmp_path):
    written = write_kitti_raw(tmp_path)
    sequence = raw(tmp_path, beam_correction_deg=0).sequence(DRIVE)
    assert len(sequence) == 6
    for scan, points in zip(sequence, written.points, strict=True):
        assert torch.equal(scan.points, torch.from_numpy(points))
        assert scan.intensities is not None and (scan.intensities == 0.5).all()
    assert torch.equal(sequence.T_world_lidar[0], torch.eye(4).double())
    assert np.allclose(sequence.timestamps - sequence.timestamps[0], 0.1 * np.arange(6), atol=1e-6)
    assert sequence.reference_frame == "lidar"
    assert raw(tmp_path).deskew


@pytest.mark.parametrize("lag", [0.0, 0.015, -0.02])
def test_poses_are_at_middle_of_sweep_for_any_packet_lag(tmp_path, lag):
    written = write_kitti_raw(tmp_path, lag=lag)
    T = raw(tmp_path).sequence(DRIVE).T_world_lidar
    assert np.allclose(T, written.T_world_lidar, atol=1e-4)  # Mercator's scale changes along the way


def test_scans_around_gap_keep_their_numbers(tmp_path, caplog):
    written = write_kitti_raw(tmp_path, dropped=(2, 3))
    sequence = raw(tmp_path).sequence(DRIVE)
    assert len(sequence) == 4 and "1 gaps" in caplog.text
    assert np.allclose(sequence.T_world_lidar, written.T_world_lidar, atol=1e-4)
    report = raw(tmp_path).check()
    assert report.usable and "gaps in the numbering: 2-3" in findings(report, "odd")


def test_sweep_times_increase_clockwise_from_rear():
    forward, right, left = [1.0, 0.0, 0.0], [0.0, -1.0, 0.0], [0.0, 1.0, 0.0]
    rear_left, rear_right = [-1.0, 1e-6, 0.0], [-1.0, -1e-6, 0.0]
    times = sweep_times(torch.tensor([rear_left, left, forward, right, rear_right]))
    assert torch.allclose(times, torch.tensor([-0.5, -0.25, 0.0, 0.25, 0.5]), atol=1e-6)


def test_odometry_sequence_selects_part_of_drive(tmp_path):
    drive, numbers = ODOMETRY_DRIVES["08"], (0, 1, 1099, 1100, 5170, 5171)
    write_kitti_raw(tmp_path, drive=drive.name, frames=6)
    scans = tmp_path / drive.name[:10] / f"{drive.name}_sync" / "velodyne_points"
    for i in (5, 4, 3, 2):
        (scans / "data" / f"{i:010d}.bin").rename(scans / "data" / f"{numbers[i]:010d}.bin")
    for end in ("start", "end"):
        lines = dict(zip(numbers, (scans / f"timestamps_{end}.txt").read_text().splitlines(), strict=True))
        (scans / f"timestamps_{end}.txt").write_text("".join(f"{lines.get(i, '')}\n" for i in range(5172)))
    data = raw(tmp_path, name="08")
    assert data.sequence("08").scans.numbers == [1100, 5170]
    assert data.sequence(drive.name).scans.numbers == [*numbers]


def test_mercator_has_unit_scale_at_first_latitude():
    position = mercator(np.array([49.0, 49.0001, 49.0]), np.array([8.4, 8.4, 8.4001]), np.array([100.0, 100.0, 101.0]))
    north, east = position[1] - position[0], position[2] - position[0]
    assert north == pytest.approx([0, np.radians(1e-4) * 6378137, 0], abs=1e-3)
    assert east == pytest.approx([np.radians(1e-4) * 6378137 * np.cos(np.radians(49)), 0, 1], abs=1e-3)


def test_missing_packets_are_reported(tmp_path):
    write_kitti_raw(tmp_path)
    (folder(tmp_path) / "oxts").rename(tmp_path / "elsewhere")
    assert raw(tmp_path).sequence(DRIVE).T_world_lidar is None
    report = raw(tmp_path).check()
    assert not report.usable and "no ground truth" in findings(report, "missing")


@pytest.mark.parametrize(
    "gone",
    [
        "calib_imu_to_velo.txt",
        f"{DRIVE}_sync/velodyne_points/timestamps_start.txt",
        f"{DRIVE}_sync/oxts/timestamps.txt",
        f"{DRIVE}_sync/velodyne_points/data",
        f"{DRIVE}_sync",
    ],
)
def test_missing_parts_are_reported(tmp_path, gone):
    write_kitti_raw(tmp_path)
    (tmp_path / "2011_09_26" / gone).rename(tmp_path / "elsewhere")
    with pytest.raises(DataSetNotFoundError, match=r"KITTI raw[\s\S]*data\.root"):
        raw(tmp_path).sequence(DRIVE)
    assert not raw(tmp_path).check().usable


@pytest.mark.parametrize("level", ["root/2011_09_26", "."])
def test_check_suggests_correct_root(tmp_path, level):
    write_kitti_raw(tmp_path / "root")
    assert raw(tmp_path / level).check().remedy == f"data.root={tmp_path / 'root'}"


@pytest.mark.parametrize(
    ("file", "content", "problem"),
    [
        ("oxts/data/0000000002.txt", "", "empty"),
        ("oxts/data/0000000002.txt", "1 2 3\n", "3 numbers"),
        ("oxts/data/0000000002.txt", "nan " * 30 + "\n", "not finite"),
        ("velodyne_points/timestamps_start.txt", "2011-09-26 13:08:24.9\n", "1 rows, too few for frame 5"),
        ("velodyne_points/timestamps_end.txt", "2011-09-26 13:08:24.9\n\n\n\n\n\n\n", "row 2 is blank"),
        ("velodyne_points/timestamps_end.txt", "yesterday\n" * 6, "not a date"),
        ("oxts/timestamps.txt", "2011-09-26 13:08:24.9\n" * 6, "ascend"),
        ("oxts/timestamps.txt", "".join(f"2012-09-26 13:08:2{i}\n" for i in range(6)), "overlap"),
        ("../calib_imu_to_velo.txt", "R: 1 2\nT: 1\n", "nine"),
    ],
)
def test_damaged_files_are_refused(tmp_path, file, content, problem):
    write_kitti_raw(tmp_path)
    (folder(tmp_path) / file).write_text(content)
    with pytest.raises(DamagedFileError, match=problem):
        raw(tmp_path).sequence(DRIVE)


def test_only_packets_around_scans_are_read(tmp_path, monkeypatch):
    write_kitti_raw(tmp_path, frames=10, lag=-0.02)
    for number in range(3):
        (folder(tmp_path) / "velodyne_points" / "data" / f"{number:010d}.bin").unlink()
    read = []
    monkeypatch.setattr(kitti_raw, "read_oxts_poses", lambda packets: read.append(packets) or read_oxts_poses(packets))
    assert raw(tmp_path).check().usable
    assert raw(tmp_path, max_frames=2).sequence(DRIVE).scans.numbers == [3, 4]
    assert [packets.numbers for packets in read] == [[3, 4], [3, 4, 5]]


def test_scans_outside_packets_are_dropped(tmp_path, caplog):
    written = write_kitti_raw(tmp_path, frames=20)
    packets = folder(tmp_path) / "oxts" / "data"
    for number in (0, 1, *range(12, 20)):
        (packets / f"{number:010d}.txt").unlink()
    sequence = raw(tmp_path).sequence(DRIVE)
    assert sequence.scans.numbers == list(range(2, 13))  # scan 12 is 0.09 s after packet 11
    assert "9 scans before or after the ground truth are left out" in caplog.text
    poses = np.linalg.inv(written.T_world_lidar[2]) @ written.T_world_lidar[2:13]
    assert np.allclose(sequence.T_world_lidar, poses, atol=1e-4)
    assert len(raw(tmp_path, max_frames=3).sequence(DRIVE)) == 3
    report = raw(tmp_path).check()
    assert report.usable and "10 GPS/IMU packets for scans numbered up to 19" in findings(report, "odd")


def test_gap_of_packets_is_logged(tmp_path, caplog):
    write_kitti_raw(tmp_path, frames=40)
    for number in range(5, 35):
        (folder(tmp_path) / "oxts" / "data" / f"{number:010d}.txt").unlink()
    assert len(raw(tmp_path).sequence(DRIVE)) == 40
    assert "31 scans lie in holes of the ground truth" in caplog.text


def test_truncated_scan_is_reported(tmp_path):
    write_kitti_raw(tmp_path)
    path = folder(tmp_path) / "velodyne_points/data/0000000001.bin"
    path.write_bytes(path.read_bytes()[:-3])
    with pytest.raises(DamagedFileError, match="0000000001"):
        raw(tmp_path).sequence(DRIVE).scan(1)
    assert not raw(tmp_path).check().usable


def test_files_of_other_names_are_no_scans_or_packets(tmp_path):
    written = write_kitti_raw(tmp_path)
    for scans, name in (("velodyne_points", "0000000002.bin"), ("oxts", "0000000002.txt")):
        file = folder(tmp_path) / scans / "data" / name
        file.with_stem(file.stem + "_copy").write_bytes(file.read_bytes())
    T = raw(tmp_path).sequence(DRIVE).T_world_lidar
    assert np.allclose(T, written.T_world_lidar, atol=1e-4)
    assert "'0000000002_copy.bin'" in findings(raw(tmp_path).check(), "odd")


def test_check_finds_drive_by_odometry_sequence(tmp_path):
    write_kitti_raw(tmp_path, drive=ODOMETRY_DRIVES["04"].name)
    report = raw(tmp_path, name="04").check()
    assert report.usable and "not among the configured" not in findings(report, "found")


@pytest.mark.realdata
def test_genuine_drive_0009(real_data):
    sequence = raw(real_data / "kitti_raw").sequence(DRIVE)
    assert len(sequence) == 31
    steps = se3.relative(sequence.T_world_lidar)
    assert steps[:, :3, 3].norm(dim=1).median() == pytest.approx(1.1, abs=0.05)
    assert (steps[:, 0, 3] > 0.9).all() and steps[:, 1, 3].abs().max() < 0.1  # forward
    times = sequence.scan(10).times
    assert times is not None and times.min() >= -0.5 and times.max() <= 0.5
    assert raw(real_data / "kitti_raw").check().usable


@pytest.mark.slow
@pytest.mark.realdata
def test_ground_truth_of_drive_0009_agrees_with_registration(real_data):
    sequence = raw(real_data / "kitti_raw").sequence(DRIVE)
    differences = []
    for i in range(2, 30, 9):
        T_ref_new = torch.linalg.inv(sequence.T_world_lidar[i]) @ sequence.T_world_lidar[i + 1]
        ref, new = (deskew(s.points, s.times, T_ref_new) for s in (sequence.scan(i), sequence.scan(i + 1)))
        reference = KdTree(voxel_size_m=0.3)
        reference.insert(ref, torch.eye(4, dtype=torch.float64), frames=1)
        registered = GaussNewton().register(new[grid_sample(new, 1.0)], reference, T_ref_new, search_distance_m=0.5)
        differences.append(float((torch.linalg.inv(T_ref_new) @ registered.T_world_lidar)[:3, 3].norm()))
    assert np.median(differences) < 0.04  # 0.05 and more without interpolation, or at the start of the sweep
