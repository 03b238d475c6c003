import numpy as np
import pytest
import torch

from lidarlearn.data.cloud_files import as_scan, read_cloud, relative_times
from lidarlearn.data.errors import DamagedFileError
from tests.data.writers import random_points, write_float32, write_pcd, write_ply

TIMES = np.linspace(0, 99_000_000, 200).astype(np.uint32)


@pytest.mark.parametrize("encoding", ["ascii", "binary", "binary_compressed"])
def test_pcd_round_trip_keeps_all_fields(tmp_path, encoding):
    write_pcd(tmp_path / "0.pcd", random_points(0), TIMES, encoding)
    cloud = read_cloud(tmp_path / "0.pcd")
    assert np.array_equal(cloud.points, random_points(0))
    assert cloud.intensities is not None and (cloud.intensities == 100).all()
    assert cloud.times is not None and np.array_equal(cloud.times, TIMES)


@pytest.mark.parametrize("encoding", ["ascii", "binary_little_endian", "binary_big_endian"])
def test_ply_round_trip_keeps_all_fields(tmp_path, encoding):
    write_ply(tmp_path / "0.ply", random_points(0), TIMES * 1e-9, encoding)
    cloud = read_cloud(tmp_path / "0.ply")
    assert np.array_equal(cloud.points, random_points(0))
    assert cloud.intensities is not None and (cloud.intensities == 100).all()
    assert cloud.times is not None and np.array_equal(cloud.times, TIMES * 1e-9)


@pytest.mark.parametrize("columns", [3, 4, 5])
def test_bin_and_npy_round_trip(tmp_path, columns):
    write_float32(tmp_path / "0.bin", random_points(0), columns)
    rows = np.fromfile(tmp_path / "0.bin", "<f4").reshape(-1, columns)
    np.save(tmp_path / "0.npy", rows.astype(np.float64))
    for path in (tmp_path / "0.bin", tmp_path / "0.npy"):
        cloud = read_cloud(path, bin_columns=columns)
        assert np.array_equal(cloud.points, random_points(0))
        assert (cloud.intensities is None) == (columns == 3)
        assert cloud.times is None


@pytest.mark.parametrize("suffix", [".pcd", ".ply"])
def test_points_that_stand_for_no_return_are_left_out_with_their_fields(tmp_path, suffix):
    points = random_points(0)
    points[3], points[5, 1] = 0, np.nan
    path = tmp_path / f"0{suffix}"
    (write_pcd if suffix == ".pcd" else write_ply)(path, points, TIMES)
    cloud = read_cloud(path)
    kept = np.delete(np.arange(200), [3, 5])
    assert np.array_equal(cloud.points, points[kept])
    assert cloud.times is not None and np.array_equal(cloud.times, TIMES[kept])
    assert cloud.intensities is not None and len(cloud.intensities) == 198


def cut(path):
    path.write_bytes(path.read_bytes()[:-7])


def cut_whole_points(path):
    path.write_bytes(path.read_bytes()[: -5 * (20 if path.suffix == ".pcd" else 24)])


@pytest.mark.parametrize("suffix", [".pcd", ".ply"])
@pytest.mark.parametrize(
    "damage", [cut, cut_whole_points, lambda p: p.write_bytes(b""), lambda p: p.write_bytes(b"x\n")]
)
def test_damaged_pcd_and_ply_name_the_file(tmp_path, suffix, damage):
    path = tmp_path / f"scan{suffix}"
    (write_pcd if suffix == ".pcd" else write_ply)(path, random_points(0), TIMES)
    damage(path)
    with pytest.raises(DamagedFileError, match=rf"scan\{suffix}"):
        read_cloud(path)


@pytest.mark.parametrize(
    "rows",
    [np.zeros((0, 4)), np.full((4, 4), np.nan), np.zeros((4, 2)), np.zeros(5), np.array(["a"] * 4)],
)
def test_npy_without_points(tmp_path, rows):
    np.save(tmp_path / "scan.npy", rows)
    with pytest.raises(DamagedFileError, match=r"scan\.npy"):
        read_cloud(tmp_path / "scan.npy")


@pytest.mark.parametrize("suffix", [".bin", ".npy", ".pcd", ".ply"])
def test_a_scan_without_a_return_is_an_empty_one(tmp_path, suffix):
    path, points = tmp_path / f"0{suffix}", np.zeros((200, 3), np.float32)
    if suffix == ".bin":
        write_float32(path, points)
    elif suffix == ".npy":
        np.save(path, points)
    else:
        (write_pcd if suffix == ".pcd" else write_ply)(path, points, TIMES)
    cloud = read_cloud(path)
    assert len(cloud.points) == 0 and cloud.file_rows == 200
    scan = as_scan(cloud, beam_correction_deg=0.2, max_intensity=255.0)
    assert scan.points.shape == (0, 3)
    assert (scan.times is not None) == (suffix in (".pcd", ".ply")) and (scan.times is None or len(scan.times) == 0)


def test_npy_runs_no_code(tmp_path):
    np.save(tmp_path / "scan.npy", np.array([{"a": 1}], dtype=object), allow_pickle=True)
    with pytest.raises(DamagedFileError, match="no array of numbers"):
        read_cloud(tmp_path / "scan.npy")


def test_fields_other_than_a_point_are_refused(tmp_path):
    (tmp_path / "0.ply").write_text("ply\nformat ascii 1.0\nelement vertex 1\nproperty float u\nend_header\n1\n")
    with pytest.raises(DamagedFileError, match=r"0\.ply"):
        read_cloud(tmp_path / "0.ply")


@pytest.mark.realdata
def test_genuine_ouster_pcd(real_data):
    cloud = read_cloud(real_data / "ouster_mcd" / "0.pcd")
    assert len(cloud.points) == 61700
    assert cloud.intensities is not None and cloud.intensities.max() > 1000
    elevation = torch.rad2deg(torch.atan2(cloud.points[:, 2], cloud.points[:, :2].norm(dim=1)))
    assert elevation.abs().quantile(0.99) < 22.5  # an OS1-64 of 45 deg; near the origin beams start off-centre


@pytest.mark.realdata
def test_genuine_ply(real_data):
    cloud = read_cloud(real_data / "hdl32_pair" / "source.ply")
    assert 60_000 < len(cloud.points) <= 69_792
    assert cloud.intensities is not None and cloud.intensities.max() == 128


def test_relative_times_of_any_unit():
    expected = torch.tensor([-0.5, 0.0, 0.5])
    for times in ([0.0, 50.0, 100.0], [1.6e9, 1.6e9 + 0.05, 1.6e9 + 0.1]):
        assert torch.allclose(relative_times(torch.tensor(times, dtype=torch.float64)), expected, atol=1e-5)
    assert torch.equal(relative_times(torch.ones(3).double()), torch.zeros(3))
