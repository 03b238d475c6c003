import json
import math
from io import StringIO
from pathlib import Path

import pytest
from rich.console import Console

from lidarlearn.evaluation.report import (
    details_table,
    drift_table,
    print_tables,
    report_tables,
    seen_in_training,
    write_report,
)
from lidarlearn.evaluation.score import Score, score

PROTOCOL = {
    "data": "simulated_urban",
    "sequences": ("a", "short"),
    "checkpoint": {"path": Path("runs/best.ckpt"), "trained_on": {"train_sequences": ["b"]}},
    "seed": 0,
    "odd": math.nan,
}


@pytest.fixture
def scores(make_sequence, longer):
    rows = []
    for method, error in (("posenet", 0.1), ("cv+p_f2m", 0.01)):
        for name, frames in (("a", 300), ("short", 50)):
            sequence = make_sequence(name, frames)
            rows.append(score(method, longer(sequence.T_world_lidar, error), sequence, 12.34))
    return rows


def cells(table, label):
    (row,) = [row for row in table.rows + table.reference if row[0] == label]
    return dict(zip(table.columns, row, strict=True))


def test_results_json_has_documented_fields(tmp_path, scores):
    write_report(tmp_path / "run", PROTOCOL, scores)
    report = json.loads((tmp_path / "run" / "results.json").read_text())
    assert list(report) == ["protocol", "results", "averages"]
    assert report["protocol"]["checkpoint"]["path"] == "runs/best.ckpt"
    promised = {
        "method", "sequence", "frames", "path_length_m", "segments", "avg_translation_error_percent",
        "avg_rotation_error_deg_per_100m", "ape_rmse_m", "rpe_translation_m", "rpe_rotation_deg",
        "registration_failures", "frames_per_second",
    }  # fmt: skip
    assert all(promised <= set(row) for row in report["results"])
    assert [(row["method"], row["sequence"]) for row in report["results"]] == [
        ("posenet", "a"), ("posenet", "short"), ("cv+p_f2m", "a"), ("cv+p_f2m", "short"),
    ]  # fmt: skip
    for averages, method in zip(report["averages"], ("posenet", "cv+p_f2m"), strict=True):
        assert averages["method"] == method
        assert set(averages) == {"method", "mean_over_sequences", "mean_over_segments"}
    first = report["results"][0]
    assert first["avg_translation_error_percent"] == scores[0].avg_translation_error_percent  # to the last digit
    assert first["by_segment_length"]["100"]["segments"] == scores[0].by_segment_length[100].segments


def test_undefined_figures_are_null(tmp_path, scores, unknown_drive):
    rows = [*scores, Score("any", "unknown", 5), Score("bad", "a", 300, frames_per_second=math.inf)]
    write_report(tmp_path, PROTOCOL, rows)
    text = (tmp_path / "results.json").read_text()
    assert "NaN" not in text
    assert "Infinity" not in text
    report = json.loads(text)
    assert report["protocol"]["odd"] is None
    short, unknown, bad = report["results"][1], report["results"][4], report["results"][5]
    assert short["segments"] == 0
    assert short["avg_translation_error_percent"] is None
    assert unknown["registration_failures"] is None
    assert bad["frames_per_second"] is None


def test_protocol_that_is_not_json_is_refused(tmp_path, scores):
    with pytest.raises(TypeError, match="not JSON serializable"):
        write_report(tmp_path, {"data": object()}, scores)


def test_drift_table_marks_training_sequences_and_short_drives(scores):
    table = drift_table("simulated_urban", scores, seen={("posenet", "a")})
    assert table.columns == ("method", "a", "short", "mean of sequences", "mean of segments")
    row = cells(table, "posenet")
    error = f"{scores[0].avg_translation_error_percent:.3f}"
    assert row["a"] == f"{error}*"
    assert cells(table, "cv+p_f2m")["a"] == f"{scores[2].avg_translation_error_percent:.3f}"  # no network in it
    assert row["short"] == f"- ({100 * scores[1].rpe_translation_mean_m:.2f} cm)"
    assert row["mean of sequences"] == row["mean of segments"] == error  # the only sequence with segments
    assert table.reference == ()
    notes = "\n".join(table.notes)
    assert "no segment of 100 m" in notes
    assert "trained on this sequence" in notes
    assert "published" not in notes


def test_seen_in_training_covers_all_methods_of_a_network():
    def network(sequence):
        return {"trained_on": {"train_sequences": [sequence]}}

    methods = ("posenet", "posenet+p_f2m", "other+kd_f2m", "cv+p_f2m")
    rows = [Score(method, sequence, 9) for method in methods for sequence in ("a", "b")]
    seen = seen_in_training({"checkpoint": network("a"), "networks": {"other": network("b")}}, rows)
    assert seen == {("posenet", "a"), ("posenet+p_f2m", "a"), ("other+kd_f2m", "b")}
    assert seen_in_training({"checkpoint": None}, rows) == set()


def test_drift_table_shows_dash_without_ground_truth(scores):
    table = drift_table("folder", [*scores, Score("posenet", "unknown", 5)])
    assert cells(table, "posenet")["unknown"] == "-"
    assert any("no ground truth" in note for note in table.notes)


def test_report_without_any_ground_truth_has_one_table():
    (table,) = report_tables("folder", [Score("m", "a", 5, frames_per_second=9.0, health={"flagged": 1})])
    assert table.columns == ("method", "sequence", "scans", "flagged", "scans/s")
    assert table.rows == (("m", "a", "5", "1", "9.0"),)
    assert "no ground truth" in table.title


def test_drift_table_of_one_sequence_has_no_means(scores):
    table = drift_table("simulated_urban", [row for row in scores if row.sequence == "a"])
    assert table.columns == ("method", "a") and {len(row) for row in table.rows} == {2}
    assert not any("averages" in note for note in table.notes)


def test_drift_table_marks_partial_means():
    def row(method, sequence):
        return Score(method, sequence, 300, 299.0, 5, 1.0, 0.1)

    table = drift_table("simulated_urban", [row("whole", "a"), row("whole", "b"), row("partial", "a")])
    assert cells(table, "partial")["b"] == "-"
    assert cells(table, "partial")["mean of sequences"] == "1.000 (1 of 2)"
    assert cells(table, "whole")["mean of sequences"] == "1.000"


def test_drift_table_shows_published_rows_for_whole_kitti():
    rows = [Score("m", "09", 1591, 1705.0, 958, 0.5, 0.2), Score("m", "04", 51, 69.0, 0)]
    table = drift_table("kitti_00-08", rows)
    kiss = cells(table, "KISS-ICP (published)")
    assert kiss["09"] == "0.504"
    assert kiss["04"] == "-"  # only a part of the sequence is scored here
    assert kiss["mean of sequences"] == "0.504"
    assert kiss["mean of segments"] == "-"  # published over all eleven sequences only
    assert any(note.startswith("published:") for note in table.notes)
    assert drift_table("kitti_00-08", rows[1:]).reference == ()
    assert drift_table("nclt", rows).reference == ()


def test_drift_table_hides_published_means_of_other_sequences():
    partly = [Score("m", "09", 1591, 1705.0, 958, 0.5, 0.2), Score("m", "08", 1000, 900.0, 400, 0.5, 0.2)]
    assert cells(drift_table("kitti_00-08", partly), "KISS-ICP (published)")["mean of sequences"] == "-"


def test_details_table_has_a_row_per_result_with_units(scores):
    table = details_table([*scores, Score("any", "unknown", 5)])
    assert [row[:2] for row in table.rows] == [*((row.method, row.sequence) for row in scores), ("any", "unknown")]
    first = dict(zip(table.columns, table.rows[0], strict=True))
    assert first["path [m]"] == f"{scores[0].path_length_m:.1f}"
    assert first["RPE [cm]"] == f"{100 * scores[0].rpe_translation_m:.2f}"
    assert first["motion [%]"] == "10.00"
    assert first["fails"] == "0"
    assert first["scans/s"] == "12.3"
    assert table.rows[-1][2:] == ("5", *("-",) * 9)


def test_results_md_and_terminal_show_same_tables(tmp_path, scores):
    write_report(tmp_path, PROTOCOL, scores)
    text = (tmp_path / "results.md").read_text()
    assert drift_table("simulated_urban", scores).markdown() in text
    assert details_table(scores).markdown() in text
    assert '- checkpoint: {"path": "runs/best.ckpt", "trained_on": {"train_sequences": ["b"]}}' in text
    out = StringIO()
    print_tables(report_tables("simulated_urban", scores), console=Console(file=out, width=200))
    printed = out.getvalue()
    for row in (*drift_table("simulated_urban", scores).rows, *details_table(scores).rows):
        assert all(cell in printed for cell in row)


def test_tables_printed_to_file_are_not_wrapped(scores, capsys):
    print_tables(report_tables("simulated_urban", scores))
    lines = capsys.readouterr().out.splitlines()
    assert sum("cv+p_f2m" in line for line in lines) == 3  # one line a row: the first table and two sequences
