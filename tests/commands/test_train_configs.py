"""Every option of every group of configs/train.yaml composes and fits what it configures."""

import inspect
from pathlib import Path

import pytest
from hydra import compose, initialize_config_dir
from hydra.utils import get_object, instantiate
from lightning.pytorch import Callback, Trainer
from lightning.pytorch.loggers import TensorBoardLogger
from omegaconf import DictConfig, OmegaConf

from lidarlearn.commands.configs import config_directory
from tests.commands.binding import check_binds

CONFIGS = config_directory()
GROUPS = ("data", "datamodule", "model", "module", "loss", "optimizer", "trainer", "callbacks", "logger")
OPTIONS = [(group, path.stem) for group in GROUPS for path in sorted((CONFIGS / group).glob("*.yaml"))]


def composed(*overrides: str) -> DictConfig:
    with initialize_config_dir(str(CONFIGS), version_base="1.3"):
        return compose("train", ["run_dir=run", *overrides])


@pytest.mark.parametrize(("group", "option"), OPTIONS)
def test_every_option_composes_and_binds_to_its_target(group, option):
    config = composed(f"{group}={option}")
    node = OmegaConf.to_container(config[group], resolve=True, throw_on_missing=True)
    if group == "trainer":  # Lightning wraps the signature
        node = {key: value for key, value in node.items() if key not in ("_target_", "logger", "callbacks")}
        assert node.keys() <= inspect.signature(Trainer).parameters.keys()
    else:
        check_binds(node)
    if group == "data":
        inspect.signature(get_object(node["_target_"])).bind(**{k: v for k, v in node.items() if k != "_target_"})


def test_every_scheduler_can_be_chosen_by_its_name():
    config = composed()
    assert set(config.schedulers) == {path.stem for path in (CONFIGS / "schedulers").glob("*.yaml")}
    check_binds(OmegaConf.to_container(config.schedulers, resolve=True))


@pytest.mark.parametrize("path", sorted((CONFIGS / "experiment").rglob("*.yaml")), ids=lambda p: p.stem)
def test_every_experiment_that_trains_composes(path):
    name = str(path.relative_to(CONFIGS / "experiment").with_suffix(""))
    if "trainer" in path.read_text():
        OmegaConf.to_container(composed(f"experiment={name}"), resolve=True, throw_on_missing=True)


def test_kitti_is_trained_as_in_the_paper():
    config = composed("data=kitti_00-08", "loss=weighted_icp")
    assert config.optimizer["_target_"] == "torch.optim.Adam" and config.optimizer.lr == 1e-4
    assert (config.trainer.max_epochs, config.scheduler) == (100, "step")
    assert config.schedulers.step.gamma == 0.5 and config.schedulers.step.milestones == [20, 40, 60, 80]
    assert config.model.backbone == "resnet18" and config.loss.sigma_m == 0.5
    assert (config.datamodule.height, config.data.projection.height, config.data.projection.width) == (None, 64, 720)


def test_the_papers_network_goes_without_what_we_added():
    config = composed("experiment=network/paper_kitti_00-08")
    assert (config.model.encoding, config.model.wrap_columns, config.datamodule.augmentation) == ("maps", False, None)


def test_simulated_data_brings_its_quick_recipe_which_the_command_line_overrides():
    quick, own = composed(), composed("trainer.max_epochs=3", "optimizer.lr=0.5", "datamodule.height=8")
    assert quick.trainer.max_epochs < 100 and quick.datamodule.height == 32 and quick.scheduler == "cosine"
    assert (own.trainer.max_epochs, own.optimizer.lr, own.datamodule.height) == (3, 0.5, 8)


@pytest.mark.parametrize(("loss", "module"), [("icp", "Unsup"), ("weighted_icp", "Unsup"), ("supervised", "Sup")])
def test_the_loss_chooses_the_module(loss, module):
    assert composed(f"loss={loss}").module["_target_"].rpartition(".")[2] == f"{module}ervisedModule"


@pytest.mark.parametrize("plus", ["", "+"])
def test_lightning_s_limits_are_set_with_or_without_a_plus(plus):
    assert composed(f"{plus}trainer.limit_train_batches=2").trainer.limit_train_batches == 2


def test_the_trainer_comes_whole_from_its_config(tmp_path):
    config = composed(f"run_dir={tmp_path}", "device=cpu", "trainer.max_epochs=7", "trainer.gradient_clip_val=0.5")
    trainer = instantiate(config.trainer)
    assert (trainer.max_epochs, trainer.gradient_clip_val) == (7, 0.5)
    assert isinstance(trainer.logger, TensorBoardLogger)
    assert Path(trainer.logger.log_dir) == tmp_path
    names = {type(callback).__name__ for callback in trainer.callbacks if isinstance(callback, Callback)}
    assert {"ProgressLines", "InputImages", "Trajectories", "ModelCheckpoint", "LearningRateMonitor"} <= names


def test_a_callback_can_be_left_out():
    assert "images" not in composed("~callbacks.images").callbacks
