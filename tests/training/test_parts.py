"""What a checkpoint may have built, and what not."""

import pytest
import torch

from lidarlearn.errors import UserError
from lidarlearn.losses.weighted_icp import WeightedIcpLoss
from lidarlearn.training.parts import UntrustedTargetError, build


def test_keys_are_the_constructor_s_arguments():
    loss = build({"_target_": "lidarlearn.losses.weighted_icp.WeightedIcpLoss", "sigma_m": 0.2})
    assert isinstance(loss, WeightedIcpLoss) and loss.sigma_m == 0.2


def test_arguments_of_run_time_are_added():
    parameters = [torch.nn.Parameter(torch.zeros(3))]
    optimizer = build({"_target_": "torch.optim.Adam", "lr": 0.5}, params=parameters)
    schedule = build({"_target_": "torch.optim.lr_scheduler.StepLR", "step_size": 2}, optimizer=optimizer)
    assert optimizer.param_groups[0]["lr"] == 0.5 and schedule.step_size == 2


@pytest.mark.parametrize(
    "target",
    [
        "os.system",
        "builtins.eval",
        "subprocess.Popen",
        "lidarlearned.Thing",
        "lidarlearn.data.cache.shutil.rmtree",  # reached through a module of ours
        "lidarlearn.training.parts.importlib.import_module",
        "lidarlearn.commands.run_folder.subprocess.Popen",
        "lidarlearn.data.cache.FileLock",  # imported by a module of ours
        "lidarlearn.data.cache.Path",
        "lidarlearn.commands.train.train",  # ours, but no class
        "torch.optim.lr_scheduler.partial",
        None,
        3,
    ],
)
def test_nothing_else_is_built(target):
    with pytest.raises(UserError, match=r"is not built|does not exist"):
        build({"_target_": target})


def test_a_missing_target_is_refused():
    with pytest.raises(UntrustedTargetError):
        build({"sigma_m": 0.2})


def test_a_wrong_key_is_named_with_the_right_ones():
    with pytest.raises(UserError, match=r"sigma_n(.|\n)*sigma_m, normal_window"):
        build({"_target_": "lidarlearn.losses.weighted_icp.WeightedIcpLoss", "sigma_n": 0.2})


@pytest.mark.parametrize(
    ("node", "words"),
    [
        ({"_target_": "lidarlearn.models.posenet.PoseNet", "backbone": "resnet17"}, "resnet17"),
        ({"_target_": "torch.optim.Adam", "lr": -1.0, "params": [torch.nn.Parameter(torch.zeros(3))]}, "learning rate"),
    ],
)
def test_a_value_that_is_refused_says_why(node, words):
    with pytest.raises(UserError, match=words):
        build(node)
