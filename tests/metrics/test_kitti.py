import math
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
import torch

from lidarlearn.geometry import se3
from lidarlearn.metrics.kitti import (
    SegmentErrors,
    average,
    average_by_length,
    path_distances,
    segment_errors,
)


def literal_definition(estimate, truth):
    """The benchmark's definition in plain loops: (first frame, length, translation, rotation) of every segment."""
    dist = [0.0]
    for a, b in pairwise(truth):
        dist.append(dist[-1] + math.sqrt(sum((b[k, 3] - a[k, 3]) ** 2 for k in range(3))))
    rows = []
    for first in range(0, len(truth), 10):
        for length in (100, 200, 300, 400, 500, 600, 700, 800):
            last = next((i for i in range(first, len(dist)) if dist[i] > dist[first] + length), None)
            if last is None:
                continue
            delta_truth = np.linalg.inv(truth[first]) @ truth[last]
            delta_estimate = np.linalg.inv(estimate[first]) @ estimate[last]
            error = np.linalg.inv(delta_estimate) @ delta_truth
            cosine = max(min(0.5 * (error[0, 0] + error[1, 1] + error[2, 2] - 1), 1.0), -1.0)
            distance = math.sqrt(error[0, 3] ** 2 + error[1, 3] ** 2 + error[2, 3] ** 2)
            rows.append((first, length, distance / length, math.acos(cosine) / length))
    return np.array(rows)


def test_scale_error_of_one_percent_matches_closed_form(straight_line):
    truth = straight_line(1000)
    estimate = truth.clone()
    estimate[:, 0, 3] *= 1.01
    mean = average(segment_errors(estimate, truth))
    # A segment of L ends after L + 1 m, so its error is 0.01 (L + 1) / L; (999 - L) // 10 + 1 of them fit.
    counts = {length: (999 - length) // 10 + 1 for length in range(100, 900, 100)}
    expected = sum(n * (length + 1) / length for length, n in counts.items()) / sum(counts.values())
    assert mean is not None
    assert mean.segments == sum(counts.values())
    assert mean.translation_percent == pytest.approx(expected, abs=1e-12)
    assert mean.translation_percent == pytest.approx(1.00435877, abs=5e-9)
    assert mean.rotation_deg_per_100m == 0


def test_identical_trajectories_have_no_error(winding_drive):
    truth = winding_drive()
    errors = segment_errors(truth, truth)
    assert len(errors.length_m) > 50
    assert errors.translation.max() < 1e-14
    assert errors.rotation.max() < 1e-9  # the arc cosine turns 1e-16 into 1e-8 rad over 100 m


@pytest.mark.parametrize(("metres", "segments"), [(100, 0), (101, 1), (110, 1), (111, 2), (201, 12)])
def test_segment_ends_strictly_beyond_its_length(straight_line, metres, segments):
    line = straight_line(metres)
    errors = segment_errors(line, line)
    assert len(errors.length_m) == segments
    mean = average(errors)
    assert (mean is None) == (segments == 0)


@pytest.mark.parametrize("poses", [0, 1, 2])
def test_too_few_poses_have_no_segment(straight_line, poses):
    line = straight_line(300)[:poses]
    assert average(segment_errors(line, line)) is None
    assert average_by_length(segment_errors(line, line)) == {}


def test_rotation_error_is_rate_of_constant_yaw_drift(straight_line):
    truth = straight_line(400)
    rate = math.radians(0.5) / 100  # rad per metre
    yaw = rate * torch.arange(len(truth), dtype=torch.float64)
    parameters = torch.zeros(len(truth), 6, dtype=torch.float64)
    parameters[:, 0] = truth[:, 0, 3]
    parameters[:, 5] = yaw
    estimate = se3.from_euler(parameters)
    errors = segment_errors(estimate, truth)
    assert torch.allclose(errors.rotation, rate * (errors.length_m + 1) / errors.length_m, rtol=1e-9)
    by_length = average_by_length(errors)
    assert list(by_length) == [100, 200, 300]
    assert by_length[200].rotation_deg_per_100m == pytest.approx(0.5 * 201 / 200)


def test_segment_errors_agree_with_literal_definition(winding_drive, perturbed):
    truth = winding_drive(700, speed=1.4)
    estimate = perturbed(truth, seed=3)
    expected = literal_definition(estimate.numpy(), truth.numpy())
    errors = segment_errors(estimate, truth)
    assert len(expected) > 200
    assert np.array_equal(errors.first_frame.numpy(), expected[:, 0])
    assert np.array_equal(errors.length_m.numpy(), expected[:, 1])
    np.testing.assert_allclose(errors.translation.numpy(), expected[:, 2], rtol=1e-9)
    np.testing.assert_allclose(errors.rotation.numpy(), expected[:, 3], rtol=1e-6)


def test_standing_still_agrees_with_literal_definition(straight_line, perturbed):
    """Frames without motion: distances that do not grow."""
    moving = straight_line(150)
    waiting = torch.cat([moving[:50], moving[50:51].repeat(30, 1, 1), moving[51:]])
    estimate = perturbed(waiting)
    expected, errors = literal_definition(estimate.numpy(), waiting.numpy()), segment_errors(estimate, waiting)
    assert np.array_equal(errors.first_frame.numpy(), expected[:, 0])
    np.testing.assert_allclose(errors.translation.numpy(), expected[:, 2], rtol=1e-9)


def test_rounded_rotations_are_inverted_not_transposed(winding_drive, perturbed):
    """Poses with seven digits: a transpose in place of the inverse changes the rotation error."""
    truth, estimate = ((1e6 * T).round() / 1e6 for T in (winding_drive(300), perturbed(winding_drive(300), 0.3)))
    expected = literal_definition(estimate.numpy(), truth.numpy())
    errors = segment_errors(estimate, truth)
    np.testing.assert_allclose(errors.translation.numpy(), expected[:, 2], rtol=1e-9)
    np.testing.assert_allclose(errors.rotation.numpy(), expected[:, 3], rtol=1e-6)


def test_segment_errors_do_not_depend_on_world_frames(winding_drive, perturbed):
    truth = winding_drive()
    estimate = perturbed(truth)
    T_a = se3.exp(torch.tensor([100.0, -20, 5, 0.3, -1.0, 2.0], dtype=torch.float64))
    T_b = se3.exp(torch.tensor([-7.0, 3, 1, 1.0, 0.5, -0.2], dtype=torch.float64))
    here, there = segment_errors(estimate, truth), segment_errors(T_a @ estimate, T_b @ truth)
    assert torch.allclose(here.translation, there.translation, rtol=1e-8)
    assert torch.allclose(here.rotation, there.rotation, rtol=1e-6)


def test_average_by_length_is_consistent_with_average(winding_drive, perturbed):
    truth = winding_drive()
    errors = segment_errors(perturbed(truth), truth)
    mean, by_length = average(errors), average_by_length(errors)
    assert mean is not None
    assert sum(a.segments for a in by_length.values()) == mean.segments
    pooled = sum(a.segments * a.translation_percent for a in by_length.values()) / mean.segments
    assert pooled == pytest.approx(mean.translation_percent)


def test_average_converts_units():
    one = torch.ones(1, dtype=torch.float64)
    errors = SegmentErrors(torch.zeros(1, dtype=torch.int64), 100 * one, 0.02 * one, math.radians(0.01) * one)
    mean = average(errors)
    assert mean is not None
    assert (mean.segments, mean.translation_percent) == (1, pytest.approx(2.0))
    assert mean.rotation_deg_per_100m == pytest.approx(1.0)


def test_path_distances_are_3d():
    T = se3.identity(3)
    T[1, :3, 3] = torch.tensor([1.0, 2.0, 2.0])
    T[2, :3, 3] = torch.tensor([1.0, 2.0, 14.0])
    assert path_distances(T).tolist() == [0, 3, 15]


def test_segment_errors_refuse_incomparable_trajectories(straight_line):
    line = straight_line(200)
    with pytest.raises(ValueError, match="200 estimated poses against 201"):
        segment_errors(line[:-1], line)
    broken = line.clone()
    broken[7, 1, 3] = math.nan
    with pytest.raises(ValueError, match="estimated pose 7 "):
        segment_errors(broken, line)
    with pytest.raises(ValueError, match="float64"):
        segment_errors(line.float(), line)


@pytest.mark.realdata
def test_segment_errors_on_published_kitti_04_poses(real_data: Path, perturbed):
    """The official rotations have seven digits: their transpose is not their inverse."""
    rows = torch.from_numpy(np.loadtxt(real_data / "kitti_odometry" / "poses" / "04.txt"))
    truth = se3.identity(len(rows))
    truth[:, :3] = rows.unflatten(1, (3, 4))
    estimate = truth[0] @ perturbed(se3.inverse(truth[:1]) @ truth)
    expected = literal_definition(estimate.numpy(), truth.numpy())
    errors = segment_errors(estimate, truth)
    assert len(expected) == len(errors.length_m) > 30
    np.testing.assert_allclose(errors.translation.numpy(), expected[:, 2], rtol=1e-9)
    np.testing.assert_allclose(errors.rotation.numpy(), expected[:, 3], rtol=1e-6)
