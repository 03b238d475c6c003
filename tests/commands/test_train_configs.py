"""The options of train.py fit what they configure."""

import inspect
from pathlib import Path

import pytest
from hydra.utils import get_object, instantiate
from lightning.pytorch import Callback, Trainer
from lightning.pytorch.loggers import TensorBoardLogger
from omegaconf import OmegaConf

from tests.commands.configs import check_binds, composed, option_nodes, options

GROUPS = ("data", "datamodule", "model", "module", "optimizer", "schedulers", "callbacks", "logger")


@pytest.fixture(scope="module")
def nodes():
    return option_nodes("train", *GROUPS)


@pytest.mark.parametrize(("group", "option"), [(group, option) for group in GROUPS for option in options(group)])
def test_option_binds_to_its_target(nodes, group, option):
    node = nodes[group, option]
    check_binds(node)
    if group == "data":
        settings = OmegaConf.to_container(node, resolve=True, throw_on_missing=True)
        inspect.signature(get_object(settings.pop("_target_"))).bind(**settings)


def test_trainer_settings_are_those_of_lightning():
    """Lightning wraps the signature of its trainer, so that `check_binds` does not apply."""
    settings = composed("train").trainer.keys() - {"_target_", "logger", "callbacks"}
    assert settings <= inspect.signature(Trainer).parameters.keys()


def test_every_scheduler_is_named_in_schedulers():
    assert set(composed("train").schedulers) == set(options("schedulers"))


def test_kitti_recipe_is_that_of_the_paper():
    config = composed("train", "data=kitti_00-08", "loss=weighted_icp")
    assert config.optimizer["_target_"] == "torch.optim.Adam" and config.optimizer.lr == 1e-4
    assert (config.trainer.max_epochs, config.scheduler) == (100, "step")
    assert config.schedulers.step.gamma == 0.5 and config.schedulers.step.milestones == [20, 40, 60, 80]
    assert config.model.backbone == "resnet18" and config.loss.sigma_m == 0.5
    assert (config.datamodule.height, config.data.projection.height, config.data.projection.width) == (None, 64, 720)


def test_paper_network_omits_our_additions():
    config = composed("train", "experiment=network/paper_kitti_00-08")
    assert (config.model.encoding, config.model.wrap_columns, config.datamodule.augmentation) == ("maps", False, None)


@pytest.mark.parametrize("data", options("recipe/for_data"))
def test_simulated_data_has_a_short_recipe(data):
    config = composed("train", f"data={data}")
    assert config.trainer.max_epochs < 100 and config.datamodule.height == 32 and config.scheduler == "cosine"


def test_command_line_overrides_recipe():
    config = composed("train", "trainer.max_epochs=3", "optimizer.lr=0.5", "datamodule.height=8")
    assert (config.trainer.max_epochs, config.optimizer.lr, config.datamodule.height) == (3, 0.5, 8)


@pytest.mark.parametrize(("loss", "module"), [("icp", "Unsup"), ("weighted_icp", "Unsup"), ("supervised", "Sup")])
def test_loss_chooses_module(loss, module):
    config = composed("train", f"loss={loss}")
    check_binds(config.loss)
    assert config.module["_target_"].rpartition(".")[2] == f"{module}ervisedModule"


@pytest.mark.parametrize("plus", ["", "+"])
def test_trainer_limits_are_set_with_or_without_plus(plus):
    assert composed("train", f"{plus}trainer.limit_train_batches=2").trainer.limit_train_batches == 2


def test_trainer_is_built_from_its_config(tmp_path):
    settings = (f"run_dir={tmp_path}", "device=cpu", "trainer.max_epochs=7", "trainer.gradient_clip_val=0.5")
    trainer = instantiate(composed("train", *settings).trainer)
    assert (trainer.max_epochs, trainer.gradient_clip_val) == (7, 0.5)
    assert isinstance(trainer.logger, TensorBoardLogger)
    assert Path(trainer.logger.log_dir) == tmp_path
    names = {type(callback).__name__ for callback in trainer.callbacks if isinstance(callback, Callback)}
    assert {"ProgressLines", "InputImages", "Trajectories", "ModelCheckpoint", "LearningRateMonitor"} <= names


def test_callback_can_be_removed():
    assert "images" not in composed("train", "~callbacks.images").callbacks
