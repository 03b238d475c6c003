import pickle

import numpy as np
import pytest
import torch

from lidarlearn.data.beam_correction import raise_beams
from lidarlearn.data.errors import DamagedFileError, DataSetNotFoundError
from lidarlearn.errors import UserError
from lidarlearn.geometry import se3
from tests.data.datasets import data_set, findings
from tests.data.writers import T_CAMERA_LIDAR, kitti_rows, write_kitti_odometry


def kitti(root, **settings):
    return data_set("kitti_00-08", root, "04", **settings)


def test_round_trip(tmp_path):
    written = write_kitti_odometry(tmp_path)
    sequence = kitti(tmp_path, beam_correction_deg=0).sequence("04")
    assert len(sequence) == 5
    for scan, points in zip(sequence, written.points, strict=True):
        assert torch.equal(scan.points, torch.from_numpy(points))
        assert scan.times is None
        assert scan.intensities is not None and (scan.intensities == 0.5).all()
    assert np.allclose(sequence.T_world_lidar, written.T_world_lidar, atol=1e-9)
    assert torch.equal(sequence.T_world_lidar[0], torch.eye(4).double())
    assert np.allclose(sequence.T_reference_lidar, T_CAMERA_LIDAR)
    assert sequence.reference_frame == "camera"
    assert np.allclose(sequence.timestamps, 0.1 * np.arange(5))


def test_beam_correction_is_on_by_default(tmp_path):
    written = write_kitti_odometry(tmp_path)
    points = kitti(tmp_path).sequence("04").scan(1).points
    assert torch.equal(points, raise_beams(torch.from_numpy(written.points[1]), 0.205))


def test_fingerprint_depends_on_beam_correction(tmp_path):
    write_kitti_odometry(tmp_path)
    a, b = (kitti(tmp_path, beam_correction_deg=angle).sequence("04").fingerprint for angle in (0.0, 0.205))
    assert a != b


def test_partial_copy_selects_rows_by_scan_number(tmp_path):
    written = write_kitti_odometry(tmp_path)
    for number in (0, 1, 4):
        (tmp_path / f"sequences/04/velodyne/{number:06d}.bin").unlink()
    sequence = kitti(tmp_path).sequence("04")
    assert len(sequence) == 2
    motion = np.linalg.inv(written.T_world_lidar[2]) @ written.T_world_lidar[3]
    assert np.allclose(sequence.T_world_lidar[1], motion, atol=1e-9)
    assert np.allclose(sequence.timestamps, [0.2, 0.3])
    assert kitti(tmp_path).check().usable


def test_sequence_with_max_frames_can_be_pickled(tmp_path):
    write_kitti_odometry(tmp_path)
    sequence = kitti(tmp_path, max_frames=2).sequence("04")
    copy = pickle.loads(pickle.dumps(sequence))
    assert len(sequence) == len(copy) == len(copy.T_world_lidar) == len(copy.timestamps) == 2
    assert torch.equal(copy.scan(1).points, sequence.scan(1).points)


def test_gap_in_numbering_is_reported(tmp_path, caplog):
    write_kitti_odometry(tmp_path)
    (tmp_path / "sequences/04/velodyne/000002.bin").unlink()
    assert len(kitti(tmp_path).sequence("04")) == 4
    assert "1 gaps" in caplog.text
    report = kitti(tmp_path).check()
    assert report.usable and "1 gaps in the numbering: 2" in findings(report, "odd")


def test_missing_poses_are_reported(tmp_path):
    write_kitti_odometry(tmp_path)
    (tmp_path / "poses/04.txt").unlink()
    assert kitti(tmp_path).sequence("04").T_world_lidar is None
    report = kitti(tmp_path).check()
    assert not report.usable and "no poses" in findings(report, "missing")
    assert kitti(tmp_path, test_sequences=[]).check().usable


@pytest.mark.parametrize("gone", ["sequences/04/calib.txt", "sequences/04/velodyne", "sequences/04", "sequences"])
def test_missing_parts_are_reported(tmp_path, gone):
    write_kitti_odometry(tmp_path)
    (tmp_path / gone).rename(tmp_path / "elsewhere")
    with pytest.raises(DataSetNotFoundError, match=r"KITTI[\s\S]*data\.root"):
        kitti(tmp_path).sequence("04")
    assert not kitti(tmp_path).check().usable


@pytest.mark.parametrize("level", ["root/sequences", "root/sequences/04", "."])
def test_correct_root_is_suggested(tmp_path, level):
    write_kitti_odometry(tmp_path / "root")
    data = kitti(tmp_path / level)
    with pytest.raises(DataSetNotFoundError, match=rf"data\.root={tmp_path / 'root'}"):
        data.sequence("04")
    report = data.check()
    assert not report.usable and report.remedy == f"data.root={tmp_path / 'root'}"


def test_fewer_poses_than_scans_are_refused(tmp_path):
    write_kitti_odometry(tmp_path)
    poses = tmp_path / "poses/04.txt"
    poses.write_text("".join(poses.read_text().splitlines(keepends=True)[:3]))
    with pytest.raises(DamagedFileError, match=r"3 rows, too few for scan 000004\.bin"):
        kitti(tmp_path).sequence("04")
    report = kitti(tmp_path).check()
    assert not report.usable and "3 poses in 04.txt, fewer than the 5" in findings(report, "missing")


def test_nan_pose_and_empty_pose_file_are_refused(tmp_path):
    write_kitti_odometry(tmp_path)
    poses = tmp_path / "poses/04.txt"
    poses.write_text(kitti_rows(np.where(np.arange(5)[:, None, None] == 3, np.nan, np.eye(4))))
    with pytest.raises(DamagedFileError, match=r"04\.txt.*the first is row 4"):
        kitti(tmp_path).sequence("04")
    poses.write_text("")
    with pytest.raises(DamagedFileError, match="empty"):
        kitti(tmp_path).sequence("04")


def test_truncated_scan_is_reported(tmp_path):
    write_kitti_odometry(tmp_path)
    path = tmp_path / "sequences/04/velodyne/000003.bin"
    path.write_bytes(path.read_bytes()[:-5])
    sequence = kitti(tmp_path).sequence("04")
    with pytest.raises(DamagedFileError, match=r"000003\.bin: truncated"):
        sequence.scan(3)
    report = kitti(tmp_path).check()
    assert not report.usable and "000003.bin (3195 bytes)" in findings(report, "missing")


def test_check_reports_small_scan(tmp_path):
    write_kitti_odometry(tmp_path)
    path = tmp_path / "sequences/04/velodyne/000003.bin"
    path.write_bytes(path.read_bytes()[:160])
    report = kitti(tmp_path).check()
    assert report.usable and "000003.bin (160 bytes)" in findings(report, "odd")


@pytest.mark.parametrize("calibration", ["", "P0: 1\n", "Tr: 1 2 3\n", "Tr: a\n"])
def test_damaged_calibration_is_refused(tmp_path, calibration):
    write_kitti_odometry(tmp_path)
    (tmp_path / "sequences/04/calib.txt").write_text(calibration)
    with pytest.raises(DamagedFileError, match=r"calib\.txt"):
        kitti(tmp_path).sequence("04")


def test_deskewing_of_compensated_scans_is_refused(tmp_path):
    write_kitti_odometry(tmp_path)
    with pytest.raises(UserError, match=r"data\.deskew=false"):
        kitti(tmp_path, deskew=True).sequence("04")


def test_check_lists_missing_and_further_sequences(tmp_path):
    write_kitti_odometry(tmp_path, "04")
    report = kitti(tmp_path, train_sequences=["00"], val_sequences=["00"], test_sequences=[9]).check()
    assert "00 no folder" in findings(report, "missing") and "09 no folder" in findings(report, "missing")
    assert "04 there (5 files), but not among" in findings(report, "found")
    assert "(04)" in report.remedy


def test_check_opens_no_damaged_scans(tmp_path, monkeypatch):
    folder = tmp_path / "sequences/00/velodyne"
    folder.mkdir(parents=True)
    for i in range(1000):
        (folder / f"{i:06d}.bin").touch()
    monkeypatch.setattr("pathlib.Path.read_bytes", lambda path: pytest.fail(f"opened {path}"))
    report = kitti(tmp_path, train_sequences=["00"], val_sequences=[], test_sequences=[]).check()
    assert "1000 scans" in findings(report, "found")
    assert "1000 empty or truncated" in findings(report, "missing")


def test_files_of_other_names_are_no_scans(tmp_path):
    written = write_kitti_odometry(tmp_path)
    velodyne = tmp_path / "sequences/04/velodyne"
    for stray in ("000002 (1).bin", "scan.bin", "0000003.bin"):
        (velodyne / stray).write_bytes((velodyne / "000002.bin").read_bytes())
    sequence = kitti(tmp_path).sequence("04")
    assert sequence.scans.numbers == [0, 1, 2, 3, 4]
    assert np.allclose(sequence.T_world_lidar, written.T_world_lidar, atol=1e-9)
    report = kitti(tmp_path).check()
    assert report.usable and "3 files that are not named like scans" in findings(report, "odd")
    assert "'0000003.bin', '000002 (1).bin', 'scan.bin'" in findings(report, "odd")


def test_error_for_missing_sequence_names_setting_and_others(tmp_path):
    write_kitti_odometry(tmp_path, "04")
    data = kitti(tmp_path, val_sequences=["09"])
    with pytest.raises(DataSetNotFoundError, match=r"change: +data\.val_sequences to .*\(04\), or data\.root"):
        data.sequence("09")


@pytest.mark.parametrize(
    ("file", "content", "problem"),
    [
        ("sequences/04/calib.txt", bytes(range(128, 256)), "cannot be read"),
        ("sequences/04/calib.txt", b"P0: 1 2 3\n", "no line 'Tr:'"),
        ("sequences/04/times.txt", b"one\ntwo\nthree\nfour\nfive\n", "not a table of numbers"),
        ("poses/04.txt", bytes(range(128, 256)) + b"\n\n\n\nx", "cannot be read"),
        ("poses/04.txt", b"1 2 3\n" * 5, "3 numbers in a row"),
    ],
)
def test_check_reports_unreadable_text_files(tmp_path, file, content, problem):
    write_kitti_odometry(tmp_path)
    (tmp_path / file).write_bytes(content)
    with pytest.raises(DamagedFileError, match=problem):
        kitti(tmp_path).sequence("04")
    report = kitti(tmp_path).check()
    assert not report.usable and problem in findings(report, "missing")


def test_check_reports_deskewing_of_compensated_scans(tmp_path):
    write_kitti_odometry(tmp_path)
    report = kitti(tmp_path, deskew=True).check()
    assert not report.usable and "data.deskew=false" in findings(report, "missing")


@pytest.mark.realdata
def test_genuine_sequence_04(real_data):
    sequence = kitti(real_data / "kitti_odometry").sequence("04")
    assert len(sequence) == 51
    steps = se3.relative(sequence.T_world_lidar)[:, :3, 3].norm(dim=1)
    assert steps.mean() == pytest.approx(1.38, abs=0.02)
    assert (sequence.T_world_lidar[-1, :3, 3] - torch.tensor([69.0, 0.0, 0.0])).norm() < 3  # straight ahead
    scan = sequence.scan(0)
    assert 100_000 < len(scan.points) < 130_000
    ground = scan.points[(scan.points[:, :2].norm(dim=1) < 10) & (scan.points[:, 2] < -1)]
    assert ground[:, 2].median() == pytest.approx(-1.7, abs=0.15)
    report = kitti(real_data / "kitti_odometry").check()
    assert report.usable and "271 poses, of which the scans need the first 51" in findings(report, "found")
