"""Building parts from plain dicts, and the targets that a checkpoint may name."""

import pytest
import torch
from torch import nn
from torch.optim import Optimizer
from torch.optim.lr_scheduler import LRScheduler

from lidarlearn.data.sequence import DataSet
from lidarlearn.errors import UserError
from lidarlearn.losses.weighted_icp import WeightedIcpLoss
from lidarlearn.training.parts import UntrustedTargetError, build, require_trusted

PARAMETER = nn.Parameter(torch.zeros(3))
PROJECTION = {"_target_": "lidarlearn.geometry.projection.SphericalProjection", "height": 16}
DATA = {
    "_target_": "lidarlearn.data.simulated.SimulatedDataSet",
    "projection": PROJECTION,
    "sensor": {"_target_": "lidarlearn.simulation.sensors.hdl64", "columns": 64},
    "train_sequences": ["urban_00"],
    "speed": None,
}
SHELL = ["-c", "alias.x=!touch PWNED", "x"]


def test_build_passes_keys_as_arguments():
    loss = build({"_target_": "lidarlearn.losses.weighted_icp.WeightedIcpLoss", "sigma_m": 0.2}, nn.Module)
    assert isinstance(loss, WeightedIcpLoss) and loss.sigma_m == 0.2


def test_build_adds_runtime_arguments():
    parameters = [torch.nn.Parameter(torch.zeros(3))]
    optimizer = build({"_target_": "torch.optim.Adam", "lr": 0.5}, Optimizer, params=parameters)
    schedule = build({"_target_": "torch.optim.lr_scheduler.StepLR", "step_size": 2}, LRScheduler, optimizer=optimizer)
    assert optimizer.param_groups[0]["lr"] == 0.5 and schedule.step_size == 2


@pytest.mark.parametrize(
    "target",
    [
        "os.system",
        "builtins.eval",
        "subprocess.Popen",
        "lidarlearned.Thing",
        "lidarlearn.data.cache.shutil.rmtree",  # a module's import
        "lidarlearn.training.parts.importlib.import_module",
        "lidarlearn.commands.run_folder.subprocess.Popen",
        "lidarlearn.data.cache.FileLock",  # a module's import
        "lidarlearn.data.cache.Path",
        "lidarlearn.commands.train.train",  # no class
        "lidarlearn.commands.compare.GatheredResults",  # a class of another kind
        "lidarlearn.data.__main__.main",  # its import would run a command
        "torch.optim.lr_scheduler.partial",
        None,
        3,
    ],
)
def test_build_refuses_untrusted_target(target):
    with pytest.raises(UserError, match=r"is refused(.|\n)*change: |does not exist"):
        build({"_target_": target}, nn.Module)


def test_build_refuses_missing_target():
    with pytest.raises(UntrustedTargetError):
        build({"sigma_m": 0.2}, nn.Module)


def test_build_names_unknown_key_and_valid_keys():
    with pytest.raises(UserError, match=r"sigma_n(.|\n)*sigma_m, normal_window"):
        build({"_target_": "lidarlearn.losses.weighted_icp.WeightedIcpLoss", "sigma_n": 0.2}, nn.Module)


@pytest.mark.parametrize(
    ("node", "kind", "words"),
    [
        ({"_target_": "lidarlearn.models.posenet.PoseNet", "backbone": "resnet17"}, nn.Module, "resnet17"),
        ({"_target_": "torch.optim.Adam", "lr": -1.0, "params": [PARAMETER]}, Optimizer, "learning rate"),
    ],
)
def test_build_reports_why_value_is_invalid(node, kind, words):
    with pytest.raises(UserError, match=words):
        build(node, kind)


def test_require_trusted_accepts_data_set_projection_and_sensor():
    require_trusted(DATA, DataSet)


@pytest.mark.parametrize(
    "node",
    [
        {"_target_": "lidarlearn.commands.run_folder._git", "_args_": SHELL},  # runs a command of the shell
        {"_target_": "lidarlearn.commands.run_folder.git_revision"},
        {"_target_": "lidarlearn.commands.data.compose_data_set", "overrides": ["data=x"]},  # returns a data set
        {"_target_": "lidarlearn.data.sequence.DataSet.__subclasses__"},
        {**DATA, "_args_": SHELL},
        {**DATA, "_partial_": True},
        {**DATA, "defaults": ["/somewhere/else"]},
        {**DATA, "projection": {"_target_": "lidarlearn.commands.run_folder.code_digest"}},
        {**DATA, "sensor": {"_target_": "lidarlearn.simulation.sensors.dataclass"}},
        {**DATA, "sensor": {"_target_": "lidarlearn.commands.run_folder._git", "_args_": SHELL}},
        {**DATA, "max_frames": {"_target_": "lidarlearn.simulation.sensors.hdl64"}},
        {**DATA, "train_sequences": [{"_target_": "lidarlearn.simulation.sensors.hdl64"}]},
        {**DATA, "pose_file": "${oc.env:HOME}"},
        {**DATA, "train_sequences": ["${oc.env:HOME}"]},
        {**DATA, "speed": torch.zeros(3)},
    ],
)
def test_require_trusted_refuses_other_nodes(node):
    with pytest.raises(UntrustedTargetError, match=r"is refused(.|\n)*change: "):
        require_trusted(node, DataSet)
