import numpy as np
import pytest
import torch
from scipy.io import savemat

from lidarlearn.data import ford_campus
from lidarlearn.data.errors import DamagedFileError, DataSetNotFoundError
from lidarlearn.errors import UserError
from tests.data.datasets import data_set, findings
from tests.data.writers import write_ford_campus

NAME = "IJRR-Dataset-1"


def ford(root, **settings):
    return data_set("ford_campus", root, NAME, **settings)


def scan_file(root, number=76):
    return root / NAME / "SCANS" / f"Scan{number:04d}.mat"


def test_round_trip(tmp_path):
    written = write_ford_campus(tmp_path)
    sequence = ford(tmp_path).sequence(NAME)
    assert len(sequence) == 4
    for scan, points in zip(sequence, written.points, strict=True):
        assert torch.equal(scan.points, torch.from_numpy(points))  # axes are converted, returns of the truck left out
        assert scan.times is None and scan.intensities is None
    assert np.allclose(sequence.T_world_lidar, written.T_world_lidar, atol=1e-9)
    assert np.allclose(sequence.timestamps - sequence.timestamps[0], 0.1 * np.arange(4), atol=1e-5)


def test_min_range_and_beam_correction_change_fingerprint(tmp_path):
    written = write_ford_campus(tmp_path)
    default, near, raised = (
        ford(tmp_path, **settings).sequence(NAME)
        for settings in ({}, {"min_range_m": 0}, {"beam_correction_deg": 0.205})
    )
    assert len(near.scan(0).points) == len(written.points[0]) + 1
    assert (raised.scan(0).points[:, 2] > default.scan(0).points[:, 2]).all()
    assert len({s.fingerprint for s in (default, near, raised)}) == 3


def test_extrinsics_move_poses_to_lidar(tmp_path):
    written = write_ford_campus(tmp_path)
    mounting = np.diag([1.0, -1.0, -1.0, 1.0])
    mounting[:3, 3] = 2.4, -0.01, -2.3
    T = ford(tmp_path, T_vehicle_lidar_m_deg=[2.4, -0.01, -2.3, 180, 0, 0]).sequence(NAME).T_world_lidar
    assert np.allclose(T, np.linalg.inv(mounting) @ written.T_world_lidar @ mounting, atol=1e-9)


def test_poses_are_cached_until_scans_change(tmp_path, monkeypatch):
    write_ford_campus(tmp_path)
    first = ford(tmp_path).sequence(NAME).T_world_lidar
    reads = []
    read_scan = ford_campus.read_scan
    monkeypatch.setattr(ford_campus, "read_scan", lambda path: reads.append(path) or read_scan(path))
    assert torch.equal(ford(tmp_path).sequence(NAME).T_world_lidar, first)
    assert not reads
    scan_file(tmp_path, 78).unlink()
    assert len(ford(tmp_path).sequence(NAME).T_world_lidar) == 3
    assert len(reads) == 3


def test_damaged_pose_cache_is_ignored(tmp_path):
    written = write_ford_campus(tmp_path)
    ford(tmp_path).sequence(NAME)
    (tmp_path / NAME / "lidarlearn_poses.npz").write_bytes(b"PK")
    assert np.allclose(ford(tmp_path).sequence(NAME).T_world_lidar, written.T_world_lidar, atol=1e-9)


@pytest.mark.parametrize("content", [b"", b"hello", None])
def test_damaged_scan_is_reported(tmp_path, content):
    write_ford_campus(tmp_path)
    path = scan_file(tmp_path)
    path.write_bytes(path.read_bytes()[:1500] if content is None else content)
    with pytest.raises(DamagedFileError, match=r"Scan0076\.mat"):
        ford(tmp_path).sequence(NAME)


def test_check_reports_empty_scan_file(tmp_path):
    write_ford_campus(tmp_path)
    scan_file(tmp_path).write_bytes(b"")
    report = ford(tmp_path).check()
    assert not report.usable and "Scan0076.mat (0 bytes)" in findings(report, "missing")


@pytest.mark.parametrize(
    ("content", "problem"),
    [
        ({"OTHER": 1}, "SCAN"),
        ({"SCAN": {"XYZ": np.zeros((3, 2))}}, "no field timestamp_laser"),
        ({"SCAN": {"timestamp_laser": [[1.0]], "X_wv": np.zeros((5, 1))}}, r"X_wv is \(5, 1\)"),
        ({"SCAN": {"timestamp_laser": [[1.0]], "X_wv": np.full((6, 1), np.nan)}}, "not finite"),
    ],
)
def test_scan_without_required_fields_is_refused(tmp_path, content, problem):
    write_ford_campus(tmp_path)
    savemat(scan_file(tmp_path), content)
    with pytest.raises(DamagedFileError, match=problem):
        ford(tmp_path).sequence(NAME)


@pytest.mark.parametrize(
    ("points", "problem"), [(np.full((3, 5), np.nan), "finite"), (np.zeros((3, 0)), "XYZ|without")]
)
def test_scan_without_points_is_refused(tmp_path, points, problem):
    write_ford_campus(tmp_path)
    savemat(scan_file(tmp_path), {"SCAN": {"timestamp_laser": [[1.0]], "X_wv": np.zeros((6, 1)), "XYZ": points}})
    with pytest.raises(DamagedFileError, match=problem):
        ford(tmp_path).sequence(NAME).scan(1)


@pytest.mark.parametrize("gone", [f"{NAME}/SCANS", NAME])
def test_missing_folder_is_reported(tmp_path, gone):
    write_ford_campus(tmp_path)
    (tmp_path / gone).rename(tmp_path / "elsewhere")
    with pytest.raises(DataSetNotFoundError, match=r"Ford Campus[\s\S]*data\.root"):
        ford(tmp_path).sequence(NAME)
    assert not ford(tmp_path).check().usable


def test_check_suggests_correct_root(tmp_path):
    write_ford_campus(tmp_path / "root")
    assert ford(tmp_path / "root" / NAME).check().remedy == f"data.root={tmp_path / 'root'}"
    assert ford(tmp_path).check().remedy == f"data.root={tmp_path / 'root'}"


def test_check_lists_further_sequences_and_gaps(tmp_path):
    write_ford_campus(tmp_path, frames=8)
    write_ford_campus(tmp_path, name="IJRR-Dataset-2")
    scan_file(tmp_path).unlink()
    report = ford(tmp_path).check()
    assert report.usable
    assert "IJRR-Dataset-2 there (4 files), but not among" in findings(report, "found")
    assert "gaps in the numbering: 76" in findings(report, "odd")


def test_check_reads_one_scan_and_caches_no_poses(tmp_path, monkeypatch):
    write_ford_campus(tmp_path)
    reads = []
    read_scan = ford_campus.read_scan
    monkeypatch.setattr(ford_campus, "read_scan", lambda path: reads.append(path) or read_scan(path))
    assert ford(tmp_path).check().usable
    assert set(reads) == {scan_file(tmp_path, 75)}
    assert not (tmp_path / NAME / "lidarlearn_poses.npz").exists()
    savemat(scan_file(tmp_path, 75), {"OTHER": np.random.default_rng(0).normal(size=1000)})
    assert "no MATLAB file with a structure SCAN" in findings(ford(tmp_path).check(), "missing")


def test_deskewing_of_compensated_scans_is_refused(tmp_path):
    write_ford_campus(tmp_path)
    with pytest.raises(UserError, match=r"data\.deskew=false"):
        ford(tmp_path, deskew=True).sequence(NAME)
