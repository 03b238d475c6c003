import numpy as np
import pytest
import torch

from lidarlearn.data.cloud_files import as_scan, read_cloud, relative_times
from lidarlearn.data.errors import DamagedFileError
from tests.data.writers import as_rows, random_points, write_float32, write_pcd, write_ply

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


@pytest.mark.parametrize("shape", [(200,), (4, 50)], ids=["flat", "organised"])
def test_npy_with_named_fields(tmp_path, shape):
    points = random_points(0)
    points[3] = np.nan
    fields = [("X", ">f8"), ("y", "<f4"), ("z", "<f4"), ("ring", "u1"), ("intensity", "u1"), ("t", "<u4")]
    rows = np.zeros(200, fields)
    rows["X"], rows["y"], rows["z"] = points.T
    rows["intensity"], rows["t"] = 7, TIMES
    np.save(tmp_path / "0.npy", rows.reshape(shape))
    cloud = read_cloud(tmp_path / "0.npy")
    assert np.array_equal(cloud.points, np.delete(points, 3, axis=0))
    assert np.array_equal(cloud.times, np.delete(TIMES, 3)) and (cloud.intensities == 7).all()


@pytest.mark.parametrize("suffix", [".pcd", ".ply"])
def test_points_without_return_are_dropped_with_their_fields(tmp_path, suffix):
    points = random_points(0)
    points[3], points[5, 1] = 0, np.nan
    path = tmp_path / f"0{suffix}"
    (write_pcd if suffix == ".pcd" else write_ply)(path, points, TIMES)
    cloud = read_cloud(path)
    kept = np.delete(np.arange(200), [3, 5])
    assert np.array_equal(cloud.points, points[kept])
    assert cloud.times is not None and np.array_equal(cloud.times, TIMES[kept])
    assert cloud.intensities is not None and len(cloud.intensities) == 198


def truncate(path):
    path.write_bytes(path.read_bytes()[:-7])


def truncate_whole_points(path):
    path.write_bytes(path.read_bytes()[: -5 * (20 if path.suffix == ".pcd" else 24)])


def empty(path):
    path.write_bytes(b"")


def replace_by_text(path):
    path.write_text("x\n")


@pytest.mark.parametrize("suffix", [".pcd", ".ply"])
@pytest.mark.parametrize(
    ("damage", "problem"),
    [
        (truncate, "truncated"),
        (truncate_whole_points, "truncated"),
        (empty, "the file is empty"),
        (replace_by_text, "no .p(cd|ly) file"),
    ],
)
def test_damaged_pcd_or_ply_error_names_file(tmp_path, suffix, damage, problem):
    path = tmp_path / f"scan{suffix}"
    (write_pcd if suffix == ".pcd" else write_ply)(path, random_points(0), TIMES)
    damage(path)
    with pytest.raises(DamagedFileError, match=rf"scan\{suffix}: {problem}"):
        read_cloud(path)


@pytest.mark.parametrize("encoding", ["ascii", "binary_little_endian", "binary_big_endian"])
@pytest.mark.parametrize(
    ("kind", "dtype"),
    [("uchar", "u1"), ("uint8", "u1"), ("ushort", "u2"), ("short", "i2"), ("float64", "f8"), ("uint32", "u4")],
)
def test_ply_vertices_of_each_type_among_other_elements(tmp_path, encoding, kind, dtype):
    """PCL writes an element `camera`, meshes have faces, and Open3D mixes both sets of type names."""
    points, values = random_points(0, 5), [0, 100, 127, 128, 255]
    header = (
        f"ply\nformat {encoding} 1.0\nelement camera 2\nproperty float k\nproperty int w\nelement vertex 5\n"
        f"property float x\nproperty float y\nproperty float z\nproperty {kind} Intensity\nproperty uchar ring\n"
        "element face 1\nproperty list uchar int vertex_indices\nend_header\n"
    )
    path = tmp_path / "0.ply"
    if encoding == "ascii":
        rows = [f"{x:.9g}\t{y:.9g}  {z:.9g} {value} 1 \n" for (x, y, z), value in zip(points, values, strict=True)]
        path.write_text(header + "1 2\n3 4\n" + "".join(rows) + "3 0 1 2\n")
    else:
        order = "<" if encoding == "binary_little_endian" else ">"
        camera = np.zeros(2, [("k", order + "f4"), ("w", order + "i4")])
        layout = [*((axis, order + "f4") for axis in "xyz"), ("i", order + dtype), ("ring", "u1")]
        rows = as_rows(points, layout, i=values, ring=1)
        path.write_bytes(header.encode() + camera.tobytes() + rows.tobytes() + bytes(13))
    cloud = read_cloud(path)
    assert np.array_equal(cloud.points, points)
    assert cloud.intensities is not None and cloud.intensities.tolist() == values


def test_ply_with_lists_before_vertices_is_refused(tmp_path):
    header = "ply\nformat {} 1.0\nelement face 1\nproperty list uchar int corners\nelement vertex 1\n"
    (tmp_path / "0.ply").write_text(header.format("binary_little_endian") + "property float x\nend_header\nabcd")
    with pytest.raises(DamagedFileError, match=r"no \.ply file that can be read \(.*list uchar int corners"):
        read_cloud(tmp_path / "0.ply")


PCD = "VERSION 0.7\nFIELDS x y z intensity\nSIZE 4 4 4 4\nTYPE F F F F\nCOUNT 1 1 1 1\nWIDTH 2\nHEIGHT 1\nPOINTS 2\n"


@pytest.mark.parametrize("encoding", ["ascii", "binary"])
@pytest.mark.parametrize(
    ("usual", "found"),
    [
        ("COUNT 1 1 1 1\n", ""),
        ("VERSION 0.7", "VERSION .6"),
        ("VERSION", "# Stra\xdfe\nVERSION"),
        ("SIZE 4 4", "SIZE  4\t4"),
        ("WIDTH 2", "VIEWPOINT 0 0 0 1 0 0 0\nWIDTH 2"),
    ],
)
def test_pcd_header_variants_are_read(tmp_path, encoding, usual, found):
    body = b"1 2 3 4\n5 6 7 8\n" if encoding == "ascii" else np.arange(1, 9, dtype="<f4").tobytes()
    header = f"{PCD}DATA {encoding}\n".replace(usual, found)
    (tmp_path / "0.pcd").write_bytes(header.encode("latin-1") + body)
    cloud = read_cloud(tmp_path / "0.pcd")
    assert cloud.points.tolist() == [[1, 2, 3], [5, 6, 7]] and cloud.intensities.tolist() == [4, 8]


@pytest.mark.parametrize("line", ["1 2 3 4 \n", "1\t2\t3\t4\n", "  1  2 3 4\r\n", "1 2 3 4"])
def test_ascii_pcd_with_single_point_and_any_whitespace(tmp_path, line):
    header = PCD.replace("WIDTH 2", "WIDTH 1").replace("POINTS 2", "POINTS 1")
    (tmp_path / "0.pcd").write_bytes(f"{header}DATA ascii\n{line}".encode())
    assert read_cloud(tmp_path / "0.pcd").points.tolist() == [[1, 2, 3]]


def test_ascii_file_with_too_few_points_is_truncated(tmp_path):
    (tmp_path / "0.pcd").write_text(f"{PCD}DATA ascii\n1 2 3 4\n")
    header = "ply\nformat ascii 1.0\nelement vertex 2\nproperty float x\nproperty float y\nproperty float z\n"
    (tmp_path / "0.ply").write_text(f"{header}end_header\n1 2 3\n")
    for name in ("0.pcd", "0.ply"):
        with pytest.raises(DamagedFileError, match="truncated: 1 points where its header says 2"):
            read_cloud(tmp_path / name)


@pytest.mark.parametrize(
    "rows",
    [
        np.zeros((0, 4)),
        np.full((4, 4), np.nan),
        np.zeros((4, 2)),
        np.zeros(5),
        np.array(["a"] * 4),
        np.zeros(4, [("u", "f4")]),
    ],
    ids=["no rows", "nan", "two columns", "one axis", "strings", "other fields"],
)
def test_npy_without_points_is_refused(tmp_path, rows):
    np.save(tmp_path / "scan.npy", rows)
    with pytest.raises(DamagedFileError, match=r"scan\.npy"):
        read_cloud(tmp_path / "scan.npy")


@pytest.mark.parametrize("suffix", [".bin", ".npy", ".pcd", ".ply"])
def test_scan_without_returns_is_empty(tmp_path, suffix):
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


def test_npy_with_pickled_objects_is_refused(tmp_path):
    np.save(tmp_path / "scan.npy", np.array([{"a": 1}], dtype=object), allow_pickle=True)
    with pytest.raises(DamagedFileError, match="no array of numbers"):
        read_cloud(tmp_path / "scan.npy")


def test_ply_without_coordinates_is_refused(tmp_path):
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


def test_relative_times_are_independent_of_unit():
    expected = torch.tensor([-0.5, 0.0, 0.5])
    for times in ([0.0, 50.0, 100.0], [1.6e9, 1.6e9 + 0.05, 1.6e9 + 0.1]):
        assert torch.allclose(relative_times(torch.tensor(times, dtype=torch.float64)), expected, atol=1e-5)
    assert torch.equal(relative_times(torch.ones(3).double()), torch.zeros(3))
