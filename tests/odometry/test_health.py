import csv

import pytest

from lidarlearn.odometry.health import Health, write_health

RECORDS = [
    Health(0, points=1200),
    Health(1, status="recovered", initialization="recovery", iterations=12, rmse_m=0.0234567891, implausible=True),
    Health(2, initialization="cv", degenerate=True, min_information=1e-4, weakest_direction=(1.0, -0.25, 0.0)),
]


def test_csv_has_one_row_per_frame_with_every_field(tmp_path):
    write_health(tmp_path / "04.health.csv", RECORDS)
    with (tmp_path / "04.health.csv").open(newline="") as file:
        rows = list(csv.DictReader(file))
    assert [int(row["frame"]) for row in rows] == [0, 1, 2]
    assert [row["status"] for row in rows] == ["ok", "recovered", "ok"]
    assert [row["flagged"] for row in rows] == ["False", "True", "True"]
    assert float(rows[1]["rmse_m"]) == pytest.approx(0.0234567891, rel=1e-5)
    assert [float(rows[2][f"weakest_{axis}"]) for axis in "xyz"] == [1.0, -0.25, 0.0]
    assert float(rows[2]["min_information"]) == 1e-4
    assert {rows[0][name] for name in ("iterations", "converged", "overlap", "rmse_m", "weakest_x")} == {""}
    assert {"initialization", "points", "iterations", "converged", "overlap", "inlier_share"} <= set(rows[0])
    assert {"degenerate", "implausible", "deviation_m", "deviation_deg"} <= set(rows[0])


@pytest.mark.parametrize(
    ("record", "flagged"),
    [
        (Health(0), False),
        (Health(0, status="recovered"), True),
        (Health(0, status="coasted"), True),
        (Health(0, status="restarted"), True),
        (Health(0, degenerate=True), True),
        (Health(0, implausible=True), True),
        (Health(0, converged=False), False),  # a step above a millimetre after thirty is no reason for doubt
    ],
)
def test_health_flags_unreliable_frames(record, flagged):
    assert record.flagged == flagged
