import numpy as np
import pytest

from lidarlearn.data.errors import DamagedFileError, DataSetNotFoundError
from lidarlearn.data.folder import Folder
from lidarlearn.errors import UserError
from lidarlearn.geometry.projection import SphericalProjection
from tests.data.datasets import findings
from tests.data.writers import as_rows, curve, kitti_rows, random_points, tum_rows, write_float32, write_pcd

TIMES = np.linspace(0, 99_000_000, 200).astype(np.uint32)


def folder(root, **settings):
    return Folder(root, SphericalProjection(), **settings)


def write_scans(directory, names=("1.bin", "2.bin", "10.bin")):
    for i, name in enumerate(names):
        write_float32(directory / name, random_points(i))


def test_each_subfolder_is_a_sequence(tmp_path):
    for name in ("run_10", "run_9"):
        write_scans(tmp_path / name)
    (tmp_path / "notes").mkdir()
    data = folder(tmp_path)
    assert data.train_sequences == data.val_sequences == data.test_sequences == ("run_9", "run_10")
    assert folder(tmp_path, test_sequences=["run_9"]).test_sequences == ("run_9",)
    assert len(data.sequence("run_9")) == 3


def test_scans_beside_subfolders_are_reported_as_left_out(tmp_path, caplog):
    write_scans(tmp_path / "drive")
    write_scans(tmp_path / "drive" / "maps", ["GlobalMap.bin"])
    data = folder(tmp_path / "drive")
    assert data.names == ("maps",) and len(data.sequences(["maps"])) == 1
    for text in (findings(data.check(), "odd"), caplog.text):
        assert f"3 scans in {tmp_path / 'drive'} itself are left out" in text
        assert "'data.test_sequences=[\"drive\"]' reads them" in text
    caplog.clear()
    chosen = folder(tmp_path / "drive", test_sequences=["drive"])
    assert len(chosen.sequences(["drive"])["drive"]) == 3
    assert "left out" not in findings(chosen.check(), "odd") + caplog.text


def test_relative_root_is_named_after_folder(tmp_path, monkeypatch):
    write_scans(tmp_path / "drive")
    (tmp_path / "drive" / "notes" / "more").mkdir(parents=True)
    (tmp_path / "drive.txt").write_text(kitti_rows(curve(3)))
    monkeypatch.chdir(tmp_path / "drive" / "notes")
    data = folder("..")
    assert data.names == ("drive",) and data.check().usable
    assert data.sequence("drive").T_world_lidar is not None
    monkeypatch.chdir(tmp_path / "drive" / "notes" / "more")
    assert folder("..").check().remedy == f"data.root={tmp_path / 'drive'}"


def test_root_with_scans_is_one_sequence_in_natural_order(tmp_path):
    write_scans(tmp_path / "drive")
    data = folder(tmp_path / "drive")
    assert data.test_sequences == ("drive",)
    sequence = data.sequence("drive")
    assert sequence.scans.names == ("1.bin", "2.bin", "10.bin")
    for i, scan in enumerate(sequence):
        assert np.array_equal(scan.points, random_points(i))
        assert scan.times is None and scan.intensities is None
    assert sequence.T_world_lidar is None and sequence.timestamps is None


def test_pcd_has_point_times_and_intensities(tmp_path):
    (tmp_path / "drive").mkdir()
    write_pcd(tmp_path / "drive" / "0.pcd", random_points(0), TIMES)
    scan = folder(tmp_path, max_intensity=200).sequence("drive").scan(0)
    assert scan.times is not None and np.allclose(scan.times, np.linspace(-0.5, 0.5, 200), atol=1e-6)
    assert scan.intensities is not None and (scan.intensities == 0.5).all()


@pytest.mark.parametrize(("stamps", "share"), [(None, 1.0), ("0\n0.1\n0.2\n", 0.5), ("0\n0.2\n0.4\n", 0.25)])
def test_point_times_are_shares_of_scan_period(tmp_path, stamps, share):
    (tmp_path / "drive").mkdir()
    for i in range(3):
        write_pcd(tmp_path / "drive" / f"{i}.pcd", random_points(0), np.linspace(2e7, 7e7, 200).astype(np.uint32))
    if stamps is not None:
        (tmp_path / "drive" / "times.txt").write_text(stamps)
    times = folder(tmp_path, deskew=True).sequence("drive").scan(1).times
    assert times is not None and np.allclose(times, share * np.linspace(-0.5, 0.5, 200), atol=1e-6)


def test_point_times_of_npy_are_shares_of_scan_period(tmp_path):
    (tmp_path / "drive").mkdir()
    (tmp_path / "drive" / "times.txt").write_text("0\n0.2\n")
    for i in range(2):
        rows = as_rows(random_points(i), [("x", "<f4"), ("y", "<f4"), ("z", "<f4"), ("t", "<u4")], t=TIMES)
        np.save(tmp_path / "drive" / f"{i}.npy", rows)
    times = folder(tmp_path, deskew=True).sequence("drive").scan(1).times
    assert np.allclose(times, 0.495 * np.linspace(-0.5, 0.5, 200), atol=1e-6)


def test_check_suggests_bin_columns_for_points_outside_image(tmp_path):
    """Files of nuScenes have a fifth number per point, the ring."""
    points = random_points(0)
    points[:, 2] = -np.abs(points[:, 2])
    (tmp_path / "bin").mkdir()
    np.column_stack([points, np.ones(200), np.arange(200) % 32]).astype("<f4").tofile(tmp_path / "bin" / "0.pcd.bin")
    (tmp_path / "npy").mkdir()
    np.save(tmp_path / "npy" / "0.npy", points[:, [0, 2, 1]])
    odd = findings(folder(tmp_path).check(), "odd").split(" | ")
    of_bin, of_npy = (line for line in odd if "outside the image" in line)
    assert "data.bin_columns where these files do not have 4 numbers" in of_bin and "bin_columns" not in of_npy
    assert "outside the image" not in findings(folder(tmp_path / "bin", bin_columns=5).check(), "odd")


def test_deskewing_requires_point_times(tmp_path):
    write_scans(tmp_path / "without")
    (tmp_path / "zero").mkdir()
    write_pcd(tmp_path / "zero" / "0.pcd", random_points(0), 0 * TIMES)
    (tmp_path / "with").mkdir()
    write_pcd(tmp_path / "with" / "0.pcd", random_points(0), TIMES)
    assert len(folder(tmp_path, deskew=True).sequence("with")) == 1
    for name in ("without", "zero"):
        with pytest.raises(UserError, match=r"data\.deskew=false"):
            folder(tmp_path, deskew=True).sequence(name)
    report = folder(tmp_path, deskew=True).check()
    assert not report.usable and "without" in findings(report, "missing")


@pytest.mark.parametrize("name", ["drive/poses.txt", "drive/groundtruth.txt", "drive.txt"])
def test_kitti_ground_truth_is_found_beside_scans(tmp_path, name):
    write_scans(tmp_path / "drive")
    (tmp_path / name).write_text(kitti_rows(curve(5)[2:]))
    expected = np.linalg.inv(curve(3)[2]) @ curve(5)[2:]
    assert np.allclose(folder(tmp_path).sequence("drive").T_world_lidar, expected, atol=1e-9)
    cut = folder(tmp_path, max_frames=2).sequence("drive")
    assert len(cut) == len(cut.T_world_lidar) == 2


def test_tum_ground_truth_is_interpolated_at_scan_times(tmp_path):
    write_scans(tmp_path / "drive")
    (tmp_path / "drive.tum").write_text(tum_rows(curve(6), 0.2 * np.arange(6)))
    (tmp_path / "drive" / "times.txt").write_text("0.2\n0.5\n0.8\n")
    sequence = folder(tmp_path).sequence("drive")
    two_steps = np.linalg.inv(curve(3)[1]) @ curve(5)[4]  # from 0.2 s to 0.8 s
    assert np.allclose(sequence.T_world_lidar[2], two_steps, atol=1e-8)
    half = sequence.T_world_lidar[1].numpy()
    assert np.allclose(half @ half, two_steps, atol=1e-8)
    assert sequence.timestamps.tolist() == [0.2, 0.5, 0.8]


def test_tum_ground_truth_without_scan_times_is_in_order(tmp_path):
    write_scans(tmp_path / "drive")
    (tmp_path / "drive" / "poses.tum").write_text(tum_rows(curve(3), [5.0, 6.0, 7.0]))
    assert np.allclose(folder(tmp_path).sequence("drive").T_world_lidar, curve(3), atol=1e-8)


@pytest.mark.parametrize(
    ("file", "content", "problem"),
    [
        ("poses.txt", kitti_rows(curve(2)), "2 poses for 3 scans"),
        ("poses.txt", "", "empty"),
        ("poses.txt", "1 2 3\n" * 3, "3 numbers"),
        ("poses.txt", "\x80\xff\xfe", "cannot be read"),
        ("times.txt", "0\n1\n2\n3\n4\n", "5 times for 3 scans"),
        ("times.txt", "0\n1\n", "2 times for 3 scans"),
        ("times.txt", "", "empty"),
        ("times.txt", "0\n2\n1\n", "do not ascend"),
    ],
)
def test_damaged_ground_truth_or_times_are_reported(tmp_path, file, content, problem):
    write_scans(tmp_path / "drive")
    (tmp_path / "drive" / file).write_bytes(content.encode("latin-1"))
    with pytest.raises(DamagedFileError, match=problem):
        folder(tmp_path).sequence("drive")
    assert not folder(tmp_path).check().usable


def test_ground_truth_of_other_clock_is_refused(tmp_path):
    write_scans(tmp_path / "drive")
    (tmp_path / "drive" / "poses.tum").write_text(tum_rows(curve(3), [5.0, 6.0, 7.0]))
    (tmp_path / "drive" / "times.txt").write_text("0.2\n0.5\n0.8\n")
    with pytest.raises(DamagedFileError, match="do not overlap"):
        folder(tmp_path).sequence("drive")


def test_scans_outside_ground_truth_are_dropped(tmp_path, caplog):
    write_scans(tmp_path / "drive")
    (tmp_path / "drive" / "times.txt").write_text("1\n2\n3\n")
    (tmp_path / "drive" / "poses.tum").write_text(
        "# time tx ty tz in m, qx qy qz qw of it\n" + tum_rows(curve(2), [2, 2.5])
    )
    sequence = folder(tmp_path, max_frames=1).sequence("drive")
    assert sequence.scans.names == ("2.bin",) and sequence.timestamps.tolist() == [2.0]
    assert np.allclose(sequence.T_world_lidar, np.eye(4))
    assert "drive: 2 scans before or after the ground truth are left out" in caplog.text


def test_scans_of_several_kinds_are_refused(tmp_path):
    write_scans(tmp_path / "drive")
    write_pcd(tmp_path / "drive" / "0.pcd", random_points(0), TIMES)
    with pytest.raises(UserError, match="several kinds"):
        folder(tmp_path).sequence("drive")
    assert not folder(tmp_path).check().usable


def test_missing_scans_are_reported(tmp_path):
    with pytest.raises(DataSetNotFoundError, match=r"data\.root"):
        folder(tmp_path / "nowhere").sequence("nowhere")
    assert not folder(tmp_path / "nowhere").check().usable
    (tmp_path / "deep" / "er").mkdir(parents=True)
    write_scans(tmp_path / "deep" / "er" / "drive")
    assert folder(tmp_path).check().remedy == f"data.root={tmp_path / 'deep' / 'er'}"


def test_error_lists_at_most_five_sequences(tmp_path):
    for i in range(9):
        write_scans(tmp_path / f"run {i}")
    with pytest.raises(DataSetNotFoundError, match=r"\(run 0, run 1, run 2, run 3, run 4, \.\.\.\)"):
        folder(tmp_path, test_sequences=["x"]).sequence("x")
    remedy = folder(tmp_path, test_sequences=["x"]).check().remedy
    assert "run 4" in remedy and "run 5" not in remedy


def test_check_reports_ground_truth_and_truncated_scan(tmp_path):
    write_scans(tmp_path / "drive")
    report = folder(tmp_path).check()
    assert report.usable and "no ground truth" in findings(report, "odd")
    (tmp_path / "drive.txt").write_text(kitti_rows(curve(3)))
    assert "with 3 rows" in findings(folder(tmp_path).check(), "found")
    (tmp_path / "drive" / "2.bin").write_bytes(b"x" * 17)
    report = folder(tmp_path).check()
    assert not report.usable and "2.bin (17 bytes)" in findings(report, "missing")


def test_fingerprint_depends_on_settings(tmp_path):
    write_scans(tmp_path / "drive")
    settings = ({}, {"beam_correction_deg": 0.1}, {"bin_columns": 5}, {"max_intensity": 255})
    assert len({folder(tmp_path, **s).sequence("drive").fingerprint for s in settings}) == 4


@pytest.mark.realdata
@pytest.mark.parametrize(("name", "count"), [("ouster_mcd", 3), ("hdl32_pair", 2)])
def test_genuine_folders(real_data, name, count):
    data = folder(real_data / name)
    sequence = data.sequence(name)
    assert len(sequence) == count
    assert all(len(scan.points) > 60_000 and scan.points.isfinite().all() for scan in sequence)
    assert data.check().usable
