"""The files of a run: trajectories, health records and a summary."""

import csv
import json

import pytest
import torch

from lidarlearn.data.sequence import Scan
from lidarlearn.errors import UserError
from lidarlearn.evaluation.run import Export, read_export, run_odometry, summarize_health
from lidarlearn.geometry import se3
from lidarlearn.odometry.base import BaseOdometry, Frame
from lidarlearn.odometry.health import Health
from tests.evaluation.conftest import DriveWithoutScans


class Numbered(DriveWithoutScans):
    """Scan i holds i + 1 points with times; one of them may be damaged."""

    damaged: int | None = None

    def scan(self, index: int) -> Scan:
        if index == self.damaged:
            raise UserError(f"scan {index} is damaged")
        return Scan(torch.full((index + 1, 3), 5.0), torch.zeros(index + 1))


class OneMetreAScan(BaseOdometry):
    """Moves by a metre with each scan, and records its input."""

    def __init__(self) -> None:
        self.fed: list[tuple[int, bool]] = []

    def register_scan(self, points, times=None) -> Frame:
        T = se3.identity()
        T[0, 3] = len(self.fed)
        self.fed.append((len(points), times is not None))
        return Frame(T, Health(len(self.fed) - 1, points=len(points)))


@pytest.fixture
def sequence(make_drive, T_camera_lidar) -> Numbered:
    sequence = Numbered("04", make_drive(6), 6, 0.1 * torch.arange(6, dtype=torch.float64), T_camera_lidar)
    return sequence


@pytest.mark.parametrize("deskew", [False, True])
def test_run_registers_scans_in_order_with_times_if_deskewing(sequence, tmp_path, deskew):
    odometry, advanced = OneMetreAScan(), []
    run_odometry(odometry, sequence, Export(tmp_path, "04"), deskew, lambda: advanced.append(1))
    assert odometry.fed == [(i + 1, deskew) for i in range(6)]
    assert len(advanced) == 6


def test_export_restores_poses(sequence, tmp_path):
    export = Export(tmp_path, "04")
    run_odometry(OneMetreAScan(), sequence, export)
    poses, summary = read_export(export, sequence)
    expected = se3.identity(6)
    expected[:, 0, 3] = torch.arange(6)
    torch.testing.assert_close(poses, expected, rtol=0, atol=1e-8)
    assert summary["frames_per_second"] > 0
    assert summary["health"]["flagged"] == 0


def test_exported_poses_are_in_reference_frame(sequence, tmp_path):
    """KITTI's camera looks along z."""
    export = Export(tmp_path, "04")
    run_odometry(OneMetreAScan(), sequence, export)
    rows = [[float(x) for x in line.split()] for line in export.kitti.read_text().splitlines()]
    assert len(rows) == 6 and len(rows[0]) == 12
    assert rows[0] == pytest.approx([1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1, 0], abs=1e-12)
    assert rows[5][11] == pytest.approx(5, abs=0.01)
    stamps = [float(line.split()[0]) for line in export.tum.read_text().splitlines() if not line.startswith("#")]
    assert stamps == pytest.approx([0.1 * i for i in range(6)])


def test_health_file_has_a_row_per_scan(sequence, tmp_path):
    export = Export(tmp_path, "04")
    run_odometry(OneMetreAScan(), sequence, export)
    with export.health.open(newline="") as file:
        assert [int(row["points"]) for row in csv.DictReader(file)] == [1, 2, 3, 4, 5, 6]


def test_poses_before_damaged_scan_are_exported_as_partial(sequence, tmp_path):
    sequence.damaged = 3
    export = Export(tmp_path, "04")
    with pytest.raises(UserError, match="scan 3 is damaged"):
        run_odometry(OneMetreAScan(), sequence, export)
    assert not export.kitti.exists()
    assert len((tmp_path / "04.partial.txt").read_text().splitlines()) == 3
    assert json.loads((tmp_path / "04.partial.json").read_text())["frames_per_second"] > 0


def test_run_replaces_files_of_earlier_run(sequence, tmp_path):
    export = Export(tmp_path, "04")
    run_odometry(OneMetreAScan(), sequence, export)
    sequence.damaged = 3
    with pytest.raises(UserError):
        run_odometry(OneMetreAScan(), sequence, export)
    assert {path.name.split(".")[1] for path in tmp_path.iterdir()} == {"partial"}
    sequence.damaged = None
    run_odometry(OneMetreAScan(), sequence, export)
    assert not list(tmp_path.glob("*.partial.*"))


def test_interrupted_run_exports_partial_poses(sequence, tmp_path):
    def interrupt() -> None:
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        run_odometry(OneMetreAScan(), sequence, Export(tmp_path, "04"), advance=interrupt)
    assert len((tmp_path / "04.partial.txt").read_text().splitlines()) == 1


def test_damaged_first_scan_exports_nothing(sequence, tmp_path):
    sequence.damaged = 0
    with pytest.raises(UserError):
        run_odometry(OneMetreAScan(), sequence, Export(tmp_path, "04"))
    assert not list(tmp_path.iterdir())


def test_sequence_without_times_and_truth_is_exported(tmp_path):
    sequence = Numbered("x", None, 3)
    run_odometry(OneMetreAScan(), sequence, Export(tmp_path, "x"))
    poses, _ = read_export(Export(tmp_path, "x"), sequence)
    assert poses[:, 0, 3].tolist() == [0, 1, 2]


def test_summary_counts_flags_and_averages_registered_frames():
    records = [
        Health(0),
        Health(1, iterations=4, rmse_m=0.02, inlier_share=0.9),
        Health(2, status="recovered", implausible=True, iterations=8, rmse_m=0.04, inlier_share=0.7),
        Health(3, status="coasted", degenerate=True, iterations=9, rmse_m=0.06, inlier_share=0.5),
        Health(4, status="coasted"),
        Health(5, status="restarted"),
    ]
    summary = summarize_health(records)
    assert summary["flagged"] == 4 and summary["recovered"] == 1 and summary["coasted"] == 3
    assert summary["degenerate"] == 1 and summary["implausible"] == 1
    assert summary["mean_iterations"] == 7 and summary["mean_rmse_m"] == pytest.approx(0.04)
    assert summary["mean_inlier_share"] == pytest.approx(0.7)


def test_summary_means_over_nothing_are_none():
    assert summarize_health([Health(0)])["mean_rmse_m"] is None
    assert summarize_health([])["mean_iterations"] is None and summarize_health([])["flagged"] == 0
