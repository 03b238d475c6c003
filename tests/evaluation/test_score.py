import math

import pytest
import torch

from lidarlearn.evaluation.score import Score, average_scores, pool_by_length, score
from lidarlearn.evaluation.trajectory_files import TrajectoryError, to_reference_frame
from lidarlearn.geometry import se3
from lidarlearn.metrics import kitti
from lidarlearn.metrics.kitti import SegmentAverage


def test_exact_trajectory_scores_zero_not_none(make_sequence):
    sequence = make_sequence("a", 150)
    row = score("perfect", sequence.T_world_lidar, sequence, frames_per_second=12.5, health={"iterations": 3})
    assert (row.method, row.sequence, row.frames, row.frames_per_second) == ("perfect", "a", 150, 12.5)
    assert row.path_length_m == pytest.approx(149, rel=1e-3)
    assert row.segments == 5
    assert row.registration_failures == 0
    assert row.health == {"iterations": 3}
    errors = (row.avg_translation_error_percent, row.ape_rmse_m, row.rpe_translation_m, row.rpe_translation_mean_m)
    assert all(error is not None and error < 1e-10 for error in errors)
    assert row.avg_rotation_error_deg_per_100m < 1e-6
    assert row.relative_translation_error_percent < 1e-10


def test_scores_of_longer_motions_match_closed_form(make_sequence, longer):
    sequence = make_sequence("a", 400)
    row = score("longer", longer(sequence.T_world_lidar, 0.02), sequence)
    motion = float(se3.relative(sequence.T_world_lidar)[:, :3, 3].norm(dim=-1).mean())
    assert row.relative_translation_error_percent == pytest.approx(2)
    assert row.rpe_translation_mean_m == pytest.approx(0.02 * motion)
    assert row.rpe_translation_m == pytest.approx(0.02 * motion, rel=1e-6)
    assert row.rpe_rotation_deg == pytest.approx(0, abs=1e-9)
    assert 1.8 < row.avg_translation_error_percent < 2.05  # the road winds, segments are shorter than their path


def test_rotation_errors_are_in_degrees(make_sequence):
    sequence = make_sequence("a", 300)
    turned = torch.zeros(299, 6, dtype=torch.float64)
    turned[:, 5] = math.radians(0.01)
    estimate = se3.accumulate(se3.relative(sequence.T_world_lidar) @ se3.exp(turned))
    row = score("turned", estimate, sequence)
    assert row.rpe_rotation_deg == pytest.approx(0.01)
    assert row.avg_rotation_error_deg_per_100m == pytest.approx(1, rel=0.02)


def test_short_drive_has_all_scores_but_kittis(make_sequence, longer):
    sequence = make_sequence("short", 60)
    row = score("longer", longer(sequence.T_world_lidar, 0.02), sequence)
    assert row.segments == 0
    assert row.avg_translation_error_percent is None
    assert row.avg_rotation_error_deg_per_100m is None
    assert row.by_segment_length == {}
    assert row.ape_rmse_m > 0.1
    assert row.rpe_translation_mean_m == pytest.approx(0.02, rel=1e-3)


def test_score_without_ground_truth_has_frames_alone(unknown_drive):
    row = score("any", se3.identity(5), unknown_drive, frames_per_second=3.0)
    assert row == Score("any", "unknown", 5, frames_per_second=3.0)
    assert row.registration_failures is None
    assert row.path_length_m is None
    assert row.segments is None


def test_single_scan_has_no_scores(make_sequence):
    row = score("any", se3.identity(1), make_sequence("one", 1))
    assert row.path_length_m == 0
    undefined = (
        row.ape_rmse_m,
        row.rpe_translation_m,
        row.registration_failures,
        row.relative_translation_error_percent,
    )
    assert undefined == (None, None, None, None)


def test_scores_are_computed_in_reference_frame(make_sequence, longer, T_camera_lidar):
    sequence = make_sequence("a", 250, T_camera_lidar)
    estimate = longer(sequence.T_world_lidar, 0.03)
    row = score("longer", estimate, sequence)
    in_camera = [to_reference_frame(T, T_camera_lidar) for T in (estimate, sequence.T_world_lidar)]
    expected = kitti.average(kitti.segment_errors(*in_camera))
    assert row.avg_translation_error_percent == expected.translation_percent
    assert row.path_length_m == float(kitti.path_distances(in_camera[1])[-1])


def test_scores_do_not_depend_on_first_pose(make_sequence, longer, T_camera_lidar):
    sequence = make_sequence("a", 250, T_camera_lidar)
    estimate = longer(sequence.T_world_lidar, 0.03)
    elsewhere = se3.exp(torch.tensor([500.0, 3, -8, 0.1, 0.2, 3.0], dtype=torch.float64)) @ estimate
    here, there = score("m", estimate, sequence), score("m", elsewhere, sequence)
    assert there.avg_translation_error_percent == pytest.approx(here.avg_translation_error_percent, rel=1e-9)
    assert there.ape_rmse_m == pytest.approx(here.ape_rmse_m, rel=1e-9)
    assert there.rpe_translation_m == pytest.approx(here.rpe_translation_m, rel=1e-9)


def test_score_refuses_wrong_number_of_poses_and_nan(make_sequence):
    sequence = make_sequence("08", 60)
    with pytest.raises(TrajectoryError, match="'m' on sequence 08: 59 poses for 60 scans"):
        score("m", sequence.T_world_lidar[1:], sequence)
    broken = sequence.T_world_lidar.clone()
    broken[31, 0, 3] = math.nan
    with pytest.raises(TrajectoryError, match="pose 31 is not finite"):
        score("m", broken, sequence)


def rows_of_three_sequences(make_sequence, longer):
    lengths_and_errors = {"a": (150, 0.01), "b": (600, 0.03), "short": (50, 0.1)}
    sequences = {name: make_sequence(name, frames) for name, (frames, _) in lengths_and_errors.items()}
    return [
        score("m", longer(sequence.T_world_lidar, lengths_and_errors[name][1]), sequence)
        for name, sequence in sequences.items()
    ]


def test_average_scores_over_sequences_and_segments(make_sequence, longer):
    rows = rows_of_three_sequences(make_sequence, longer)
    (averages,) = average_scores(rows)
    a, b, _ = rows
    over_sequences, over_segments = averages.mean_over_sequences, averages.mean_over_segments
    assert over_sequences.sequences == 2  # the short one has no segment
    assert over_sequences.avg_translation_error_percent == pytest.approx(
        (a.avg_translation_error_percent + b.avg_translation_error_percent) / 2
    )
    assert over_segments.segments == a.segments + b.segments
    pooled = a.segments * a.avg_translation_error_percent + b.segments * b.avg_translation_error_percent
    assert over_segments.avg_translation_error_percent == pytest.approx(pooled / (a.segments + b.segments))
    assert over_sequences.avg_translation_error_percent < over_segments.avg_translation_error_percent
    assert over_sequences.ape_rmse_m == pytest.approx(sum(row.ape_rmse_m for row in rows) / 3)
    assert over_sequences.frames_per_second is None


def test_average_scores_keeps_methods_apart_in_order():
    rows = [
        Score("z", "1", 10, registration_failures=2, frames_per_second=10.0),
        Score("a", "1", 10),
        Score("z", "2", 10, registration_failures=1, frames_per_second=20.0),
    ]
    z, a = average_scores(rows)
    assert (z.method, a.method) == ("z", "a")
    assert z.mean_over_sequences.registration_failures == 3
    assert z.mean_over_sequences.frames_per_second == 15
    assert a.mean_over_sequences.registration_failures is None
    assert a.mean_over_segments.avg_translation_error_percent is None


def test_pool_by_length_weights_by_segments():
    rows = [
        Score("m", "1", 10, by_segment_length={100: SegmentAverage(1, 1.0, 0.1)}),
        Score("m", "2", 10, by_segment_length={100: SegmentAverage(3, 2.0, 0.5), 200: SegmentAverage(2, 4.0, 0.0)}),
    ]
    pooled = pool_by_length(rows)
    assert list(pooled) == [100, 200]
    assert (pooled[100].segments, pooled[100].translation_percent) == (4, pytest.approx(1.75))
    assert pooled[100].rotation_deg_per_100m == pytest.approx(0.4)
    assert pooled[200] == SegmentAverage(2, 4.0, 0.0)
