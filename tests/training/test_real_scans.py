"""Unsupervised training on real scans: KITTI 04, each scan both for training and for validation."""

import pytest
from hydra import compose, initialize_config_dir

from lidarlearn.commands.configs import config_directory
from lidarlearn.commands.train import train
from tests.training.runs import curves


@pytest.mark.slow
@pytest.mark.realdata
@pytest.mark.parametrize("loss", ["icp", "weighted_icp"])
def test_unsupervised_training_learns_motion_of_kitti_04(loss, real_data, tmp_path):
    """The car moves 1.38 m a scan; the network's error falls below 5 cm."""
    overrides = [
        "experiment=kitti_04_mapping",
        f"loss={loss}",
        f"data.root={real_data}/kitti_odometry",
        f"datamodule.cache_root={tmp_path}/cache",
        f"run_dir={tmp_path}/run",
        "device=cpu",
    ]
    with initialize_config_dir(str(config_directory()), version_base="1.3"):
        train(compose("train", overrides), data_name="kitti_00-08")
    assert curves(tmp_path / "run")["val/mean_relative_translation_error_m"][-1][1] <= 0.05
