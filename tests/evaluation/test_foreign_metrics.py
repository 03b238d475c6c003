"""Scores of foreign trajectories agree with KISS-ICP's and evo's own metrics."""

import numpy as np
import pytest
import torch
from evo.core import metrics
from evo.core.trajectory import PosePath3D

from lidarlearn.data.pose_files import write_kitti_poses
from lidarlearn.evaluation.score import score
from lidarlearn.evaluation.trajectory_files import read_trajectory, to_lidar_frame
from lidarlearn.geometry import se3


@pytest.mark.parametrize("seed", range(10))
def test_scores_agree_with_kiss_icp_and_evo(tmp_path, make_sequence, T_camera_lidar, seed):
    generator = torch.Generator().manual_seed(seed)
    sequence = make_sequence("00", 300 + 60 * seed, T_camera_lidar)
    noise = torch.randn(len(sequence), 6, generator=generator, dtype=torch.float64)
    noise *= torch.tensor([0.03, 0.01, 0.01, 5e-4, 5e-4, 1e-3], dtype=torch.float64)
    T_world_lidar = se3.accumulate(se3.relative(sequence.T_world_lidar) @ se3.exp(noise[1:]))
    T_world_camera = T_camera_lidar @ T_world_lidar @ se3.inverse(T_camera_lidar)
    write_kitti_poses(tmp_path / "00.txt", T_world_camera)

    poses = read_trajectory(tmp_path / "00.txt", sequence.timestamps)
    lidar = to_lidar_frame(poses, "camera", sequence)
    ours = score("other", lidar, sequence)

    estimate = poses.numpy()
    truth = (T_camera_lidar @ sequence.T_world_lidar @ se3.inverse(T_camera_lidar)).numpy()
    ape = metrics.APE(metrics.PoseRelation.translation_part)
    reference, other = PosePath3D(poses_se3=list(truth)), PosePath3D(poses_se3=list(estimate))
    other.align(reference)
    ape.process_data((reference, other))
    assert ours.ape_rmse_m == pytest.approx(ape.get_statistic(metrics.StatisticsType.rmse), abs=1e-6)

    kiss = pytest.importorskip("kiss_icp.metrics")
    percent, deg_per_100m = kiss.sequence_error(truth, estimate)
    assert ours.avg_translation_error_percent == pytest.approx(percent, abs=1e-6)
    assert ours.avg_rotation_error_deg_per_100m == pytest.approx(np.abs(100 * deg_per_100m), rel=2e-3)
