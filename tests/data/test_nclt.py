import numpy as np
import pytest
import torch

from lidarlearn.data.errors import DamagedFileError, DataSetNotFoundError
from lidarlearn.data.nclt import POINT
from lidarlearn.errors import UserError
from tests.data.datasets import data_set, findings
from tests.data.writers import relative_to_first, write_nclt

DATE = "2012-01-08"


def nclt(root, **settings):
    return data_set("nclt", root, DATE, **settings)


def truth_file(root):
    return root / DATE / f"groundtruth_{DATE}.csv"


@pytest.mark.parametrize("height", [0.0, 1.03])
def test_round_trip(tmp_path, height):
    written = write_nclt(tmp_path, sensor_height_m=height)
    sequence = nclt(tmp_path, sensor_height_m=height).sequence(DATE)
    assert len(sequence) == 5
    for scan, points in zip(sequence, written.points, strict=True):
        assert np.allclose(scan.points, points, atol=1e-5)
        assert scan.points[0, 0] == pytest.approx(80, abs=0.003)  # no overflow
        assert scan.times is None
        assert scan.intensities is not None and torch.allclose(scan.intensities, torch.tensor(0.2))
    assert np.allclose(sequence.T_world_lidar, written.T_world_lidar, atol=1e-6)
    assert np.allclose(sequence.timestamps - sequence.timestamps[0], 0.1 * np.arange(5), atol=1e-5)


def test_ground_truth_folder_beside_dates_is_found(tmp_path):
    written = write_nclt(tmp_path)
    (tmp_path / "ground_truth").mkdir()
    truth_file(tmp_path).rename(tmp_path / "ground_truth" / truth_file(tmp_path).name)
    assert np.allclose(nclt(tmp_path).sequence(DATE).T_world_lidar, written.T_world_lidar, atol=1e-6)


def test_nan_rows_of_ground_truth_are_dropped(tmp_path):
    written = write_nclt(tmp_path)
    lines = truth_file(tmp_path).read_text().splitlines()
    lines[12] = lines[12].split(",")[0] + ", nan" * 6
    truth_file(tmp_path).write_text("\n".join(lines) + "\n")
    T = nclt(tmp_path).sequence(DATE).T_world_lidar
    assert T.isfinite().all() and np.allclose(T, written.T_world_lidar, atol=1e-6)


def test_scans_outside_ground_truth_are_dropped(tmp_path, caplog):
    written = write_nclt(tmp_path)
    lines = truth_file(tmp_path).read_text().splitlines()
    truth_file(tmp_path).write_text("\n".join(lines[8:35]) + "\n")  # from 70 ms to 330 ms
    sequence = nclt(tmp_path).sequence(DATE)
    assert len(sequence) == 3
    assert "2 scans before or after" in caplog.text
    assert np.allclose(sequence.T_world_lidar, relative_to_first(written.T_world_lidar[1:4]), atol=1e-6)
    assert np.allclose(sequence.scan(0).points, written.points[1], atol=1e-5)


def test_gap_of_ground_truth_is_logged(tmp_path, caplog):
    write_nclt(tmp_path)
    first = int(truth_file(tmp_path).read_text().splitlines()[1].split(",")[0])
    rows = [f"{first}, 0, 0, 0, 0, 0, 0", f"{first + 3_000_000}, 1, 0, 0, 0, 0, 0"]
    truth_file(tmp_path).write_text("\n".join(rows) + "\n")
    assert len(nclt(tmp_path).sequence(DATE)) == 5
    assert "holes of the ground truth" in caplog.text


def test_missing_ground_truth_is_reported(tmp_path):
    write_nclt(tmp_path)
    truth_file(tmp_path).unlink()
    sequence = nclt(tmp_path).sequence(DATE)
    assert sequence.T_world_lidar is None and len(sequence) == 5
    report = nclt(tmp_path).check()
    assert not report.usable and f"groundtruth_{DATE}.csv" in findings(report, "missing")


@pytest.mark.parametrize(
    ("content", "problem"),
    [
        ("", "empty"),
        ("1, nan, nan, nan, nan, nan, nan\n", "0 rows without NaN"),
        ("1, 2, 3\n", "3 numbers"),
        ("2, 0, 0, 0, 0, 0, 0\n1, 0, 0, 0, 0, 0, 0\n", "ascend"),
        ("1, 0, 0, 0, 0, 0, 0\n2, 0, 0, 0, 0, 0, 0\n", "do not overlap"),
    ],
)
def test_damaged_ground_truth_is_refused(tmp_path, content, problem):
    write_nclt(tmp_path)
    truth_file(tmp_path).write_text(content)
    with pytest.raises(DamagedFileError, match=problem):
        nclt(tmp_path).sequence(DATE)


def test_check_reports_empty_ground_truth(tmp_path):
    write_nclt(tmp_path)
    truth_file(tmp_path).write_text("")
    report = nclt(tmp_path).check()
    assert not report.usable and "empty ground truth" in findings(report, "missing")


def test_truncated_scan_is_reported(tmp_path):
    write_nclt(tmp_path)
    path = nclt(tmp_path).sequence(DATE).scans.path(2)
    path.write_bytes(path.read_bytes()[:-3])
    with pytest.raises(DamagedFileError, match=r"truncated.*8 bytes"):
        nclt(tmp_path).sequence(DATE).scan(2)
    report = nclt(tmp_path).check()
    assert not report.usable and path.name in findings(report, "missing")


@pytest.mark.parametrize("gone", [f"{DATE}/velodyne_sync", DATE])
def test_missing_folder_is_reported(tmp_path, gone):
    write_nclt(tmp_path)
    (tmp_path / gone).rename(tmp_path / "elsewhere")
    with pytest.raises(DataSetNotFoundError, match=r"NCLT[\s\S]*data\.root"):
        nclt(tmp_path).sequence(DATE)
    assert not nclt(tmp_path).check().usable


@pytest.mark.parametrize("level", [f"root/{DATE}", f"root/{DATE}/velodyne_sync", "."])
def test_check_suggests_correct_root(tmp_path, level):
    write_nclt(tmp_path / "root")
    assert nclt(tmp_path / level).check().remedy == f"data.root={tmp_path / 'root'}"


def test_deskewing_of_compensated_scans_is_refused(tmp_path):
    write_nclt(tmp_path)
    with pytest.raises(UserError, match=r"data\.deskew=false"):
        nclt(tmp_path, deskew=True).sequence(DATE)


@pytest.mark.realdata
def test_genuine_scan(real_data):
    data = nclt(real_data / "nclt")
    sequence = data.sequence("2012-01-15")
    points = sequence.scan(0).points
    assert len(points) == 23546
    assert points.norm(dim=1).max() < 100
    assert (points[:, 0] > 63.84).float().mean() == pytest.approx(0.00055, abs=0.00001)  # 0 if read as signed
    rows = np.fromfile(sequence.scans.path(0), POINT)
    assert sorted(np.unique(rows["laser"])) == list(range(32))
    near = points[points[:, :2].norm(dim=1) < 8]
    assert near[:, 2].median() == pytest.approx(-1.03, abs=0.1)  # the ground is below
    # The elevations of the beams are those of the HDL-32's data sheet, upside down.
    elevation = np.degrees(np.arctan2(points[:, 2].numpy(), points[:, :2].norm(dim=1).numpy()))
    medians = sorted(np.median(elevation[rows["laser"] == laser]) for laser in range(32))
    assert np.allclose(medians, np.linspace(-10.67, 30.67, 32), atol=0.02)
    assert "2012-01-15 there (1 files)" in findings(data.check(), "found")
