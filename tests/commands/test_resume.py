"""`ckpt=...`: train.py and evaluate.py take settings from the checkpoint unless the command line gives them."""

import functools
import operator
import shutil
import sys
from pathlib import Path

import pytest
import torch
from hydra import compose, initialize_config_dir
from hydra.utils import instantiate
from lightning.pytorch import Trainer
from omegaconf import OmegaConf

from lidarlearn.commands import evaluate, train
from lidarlearn.commands.checkpoint_options import add_data, add_to_search_path, given_checkpoint, write_option
from lidarlearn.commands.configs import config_directory
from lidarlearn.commands.resume import add_settings
from lidarlearn.errors import UserError
from lidarlearn.training.parts import UntrustedTargetError
from lidarlearn.training.resuming import require_resumable
from tests.commands.scans import FRAMES, SENSOR
from tests.training.runs import curves

pytestmark = pytest.mark.filterwarnings("ignore::DeprecationWarning:tensorboard")

RUN = (
    "data=folder", *SENSOR, "data.train_sequences=['0']", "data.val_sequences=['1']", "data.test_sequences=['1']",
    f"data.max_frames={FRAMES}", "datamodule.batch_size=2", "datamodule.height=16", "loss=icp", "optimizer=adamw",
    "optimizer.lr=1e-3", "model.rotation_scale=0.2", "schedulers.step.milestones=[1]", "seed=7",
    "trainer.limit_train_batches=2", "trainer.max_epochs=2",
)  # fmt: skip


def run(folder, root, *arguments):
    """Run train.py; the last checkpoint. The settings added here depend on the machine and may differ on resuming."""
    own = ["device=cpu", f"data.root={root}", f"datamodule.cache_root={folder.parent}/cache",
           "datamodule.num_workers=0", "datamodule.preparation_workers=0", "trainer.log_every_n_steps=1",
           "~callbacks.images", "~callbacks.trajectories", f"hydra.run.dir={folder}"]  # fmt: skip
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(sys, "argv", ["train.py", *arguments, *own])
        train.main()
    return folder / "checkpoints" / "last.ckpt"


@pytest.fixture(scope="module")
def checkpoint(scans, tmp_path_factory):
    """The checkpoint of a finished training, with settings that all differ from the defaults."""
    return run(tmp_path_factory.mktemp("runs") / "run", scans, *RUN)


def composed(folder: Path, checkpoint: Path, *overrides: str, program: str = "train"):
    """The config of a command line with `ckpt=...`."""
    shutil.rmtree(folder, ignore_errors=True)
    arguments = ["x.py", f"ckpt={checkpoint}", "run_dir=x", *overrides]
    (add_settings if program == "train" else add_data)(arguments, folder)
    with initialize_config_dir(str(config_directory()), version_base="1.3"):
        return compose(program, arguments[1:])


@pytest.fixture(scope="module")
def resumed_config(checkpoint, tmp_path_factory):
    """The config of the training that resumes the checkpoint; tests change copies of it."""
    return composed(tmp_path_factory.mktemp("options"), checkpoint)


def user_option(tmp_path: Path, name: str, content: str) -> str:
    """Write an option into a folder of the user; the override that adds the folder to the search path."""
    place = tmp_path / "my, options" / name
    place.parent.mkdir(parents=True)
    place.write_text(content)
    return f"hydra.searchpath=['file://{tmp_path}/my, options']"


def test_resumed_training_keeps_its_settings(resumed_config):
    config = resumed_config
    assert config.data.train_sequences == ["0"] and config.data.projection.fov_up_deg == 15.0
    assert (config.datamodule.batch_size, config.datamodule.height, config.seed) == (2, 16, 7)
    assert config.loss["_target_"].endswith("IcpLoss") and config.module["_target_"].endswith("UnsupervisedModule")
    assert (config.optimizer["_target_"], config.optimizer.lr) == ("torch.optim.AdamW", 1e-3)
    assert config.model.rotation_scale == 0.2
    assert (config.scheduler, config.schedulers.step.milestones) == ("step", [1])
    assert (config.trainer.max_epochs, config.trainer.limit_train_batches) == (2, 2)


def test_data_name_is_that_of_the_checkpoint(checkpoint, tmp_path, monkeypatch):
    """And not "checkpoint", the option that holds its data settings."""
    names = []
    for command, name in ((train, "train"), (evaluate, "evaluate")):
        monkeypatch.setattr(command, name, lambda config, data_name: names.append(data_name) or checkpoint)
        monkeypatch.setattr(sys, "argv", ["x.py", f"ckpt={checkpoint}", f"hydra.run.dir={tmp_path}/{name}"])
        command.main()
    assert names == ["folder", "folder"]


def test_module_settings_are_kept_unless_overridden(checkpoint, tmp_path):
    content = torch.load(checkpoint, weights_only=True)
    content["hyper_parameters"]["compile_loss"] = False
    torch.save(content, tmp_path / "eager.ckpt")
    assert composed(tmp_path / "o", tmp_path / "eager.ckpt").module.compile_loss is False
    assert composed(tmp_path / "o", tmp_path / "eager.ckpt", "module.compile_loss=auto").module.compile_loss == "auto"


@pytest.mark.parametrize("program", ["train", "evaluate"])
def test_experiment_without_data_takes_them_from_checkpoint(checkpoint, tmp_path, program):
    folder = user_option(tmp_path, "experiment/seeded.yaml", "# @package _global_\nseed: 3\n")
    config = composed(tmp_path / "o", checkpoint, folder, "experiment=seeded", program=program)
    assert (config.seed, config.data.max_frames) == (3, FRAMES)


def test_experiment_with_data_overrides_those_of_checkpoint(checkpoint, tmp_path):
    config = composed(tmp_path / "o", checkpoint, "experiment=paper/kitti_sim", program="evaluate")
    assert config.data["_target_"].endswith("SimulatedDataSet")


@pytest.mark.parametrize(("program", "add"), [("train", add_settings), ("evaluate", add_data)])
def test_flags_may_follow_overrides(checkpoint, tmp_path, program, add):
    arguments = [f"{program}.py", f"ckpt={checkpoint}", "seed=0,1", "-m", "--config-dir", "mine"]
    add(arguments, tmp_path / "o")
    assert arguments[-3:] == ["-m", "--config-dir", "mine"] and "recipe=checkpoint" in arguments[1:-3]


@pytest.mark.parametrize("order", [["recipe=paper", "CKPT"], ["CKPT", "recipe=paper"]])
def test_recipe_of_checkpoint_wins_over_another_recipe(checkpoint, tmp_path, order):
    arguments = ["train.py", *(f"ckpt={checkpoint}" if word == "CKPT" else word for word in order), "run_dir=x"]
    add_settings(arguments, tmp_path / "o")
    with initialize_config_dir(str(config_directory()), version_base="1.3"):
        config = compose("train", arguments[1:])
    assert config.datamodule.batch_size == 2 and config.data.max_frames == FRAMES


def test_omitted_scheduler_arguments_count_as_their_defaults(checkpoint, tmp_path):
    content = torch.load(checkpoint, weights_only=True)
    parts = content["hyper_parameters"]
    parts["scheduler"] = {"_target_": "lidarlearn.training.schedules.WarmUpCosine", "total_steps": None}
    parts["trained_on"]["settings"]["scheduler"] = "cosine"
    torch.save(content, tmp_path / "cosine.ckpt")
    config = composed(tmp_path / "o", tmp_path / "cosine.ckpt")
    assert OmegaConf.to_container(config, resolve=True)["scheduler"] == "cosine"
    module = train.build_module(config, instantiate(config.datamodule), "folder")
    trainer = Trainer(accelerator="cpu", max_epochs=3)
    require_resumable(tmp_path / "cosine.ckpt", module, trainer)
    module.hparams["scheduler"]["start_share"] = 0.3
    with pytest.raises(UserError, match=r"start_share was 0\.1 and is 0\.3"):
        require_resumable(tmp_path / "cosine.ckpt", module, trainer)


def test_command_line_and_experiment_override_checkpoint(checkpoint, tmp_path):
    config = composed(tmp_path / "o", checkpoint, "datamodule.batch_size=3", "data.max_frames=4", "data=folder")
    assert (config.datamodule.batch_size, config.data.max_frames) == (3, 4)
    config = composed(tmp_path / "o", checkpoint, "experiment=network/simulated_mapping")
    assert (config.trainer.max_epochs, config.seed, config.datamodule.batch_size) == (14, 7, 2)
    assert config.data["_target_"].endswith("SimulatedDataSet") and len(config.data.train_sequences) == 5
    assert config.loss["_target_"].endswith("WeightedIcpLoss")


@pytest.mark.parametrize("name", ["t m,p", "t=(1)", "John Doe's", 'a"b', "a\\b\\", "[x]{y: z}", "é"])
def test_temporary_folder_may_have_any_name(tmp_path, name):
    write_option(tmp_path / name, "data", {"defaults": ["folder@_here_", "_self_"], "max_frames": FRAMES})
    arguments = ["ckpt=a.ckpt"]
    add_to_search_path(arguments, tmp_path / name, "data=checkpoint")
    with initialize_config_dir(str(config_directory()), version_base="1.3"):
        assert compose("data", arguments[1:]).data.max_frames == FRAMES


def test_search_path_of_the_user_is_kept(checkpoint, tmp_path):
    folder = user_option(tmp_path, "projection/mine.yaml", "defaults: [hdl64@_here_, _self_]\nheight: 17\n")
    config = composed(tmp_path / "o", checkpoint, folder, "projection@data.projection=mine", "data=folder")
    assert config.data.projection.height == 17


@pytest.mark.parametrize(("program", "remedy"), [("train", "one at a time$"), ("evaluate", r"add data=\.\.\.$")])
def test_sweep_over_checkpoints_is_refused(tmp_path, program, remedy):
    with pytest.raises(UserError, match=remedy):
        composed(tmp_path / "o", Path("a.ckpt,b.ckpt"), program=program)


def test_last_of_two_checkpoints_counts():
    assert given_checkpoint(["x.py", "ckpt=a.ckpt", "seed=1", "++ckpt=b.ckpt"], "one at a time") == Path("b.ckpt")


@pytest.mark.parametrize("arguments", [["ckpt=a.ckpt,b.ckpt"], ["ckpt=a.ckpt", "hydra/launcher=submitit_slurm"]])
def test_experiment_chooses_data_where_checkpoint_cannot(tmp_path, arguments):
    command = ["evaluate.py", *arguments, "experiment=paper/kitti_sim", "-m"]
    add_data(command, tmp_path / "o")
    assert command == ["evaluate.py", *arguments, "experiment=paper/kitti_sim", "-m"]


@pytest.mark.parametrize("program", ["train", "evaluate"])
def test_slurm_launcher_is_refused(checkpoint, tmp_path, program):
    with pytest.raises(UserError, match=r"submitit_slurm: its nodes do not see(.|\n)*change: submit a job"):
        composed(tmp_path / "o", checkpoint, "hydra/launcher=submitit_slurm", program=program)


@pytest.mark.parametrize(
    ("setting", "message"),
    [
        ("optimizer.lr=1e-5", r"another optimizer: lr was 0\.001 and is 1e-05"),
        ("optimizer._target_=torch.optim.Adam", r"another optimizer: _target_ was torch\.optim\.AdamW"),
        ("schedulers.step.milestones=[1,2]", r"another scheduler: milestones was \[1\]"),
        ("scheduler=cosine", "another scheduler"),
        ("schedulers.step.gamma=0.1", "another scheduler: gamma"),
        ("loss._target_=lidarlearn.losses.weighted_icp.WeightedIcpLoss", "another loss: _target_"),
        ("model.backbone=resnet34", "another model: backbone"),
        ("trainer.max_epochs=2", r"2 of 2 epochs\n  change: trainer\.max_epochs=4"),
    ],
)
def test_resuming_refuses_other_parts_and_finished_training(checkpoint, resumed_config, setting, message):
    config = resumed_config.copy()
    config.merge_with_dotlist([setting])
    module = train.build_module(config, instantiate(config.datamodule), "folder")
    with pytest.raises(UserError, match=message):
        require_resumable(checkpoint, module, Trainer(accelerator="cpu", max_epochs=config.trainer.max_epochs))


def test_longer_training_repeats_the_batches_of_an_unbroken_run(checkpoint, scans, tmp_path):
    run(tmp_path / "unbroken", scans, *RUN[:-1], "trainer.max_epochs=4")
    again = run(tmp_path / "again", scans, f"ckpt={checkpoint}", "trainer.max_epochs=4")
    whole, rest = curves(tmp_path / "unbroken"), curves(tmp_path / "again")
    assert rest["train/loss_step"] == whole["train/loss_step"][4:]  # the very same batches
    trained_on = torch.load(again, weights_only=True)["hyper_parameters"]["trained_on"]
    assert trained_on["data_name"] == "folder" and "root" not in trained_on["data"]


@pytest.mark.slow
def test_resuming_warns_of_batches_skipped_within_an_epoch(scans, tmp_path, capsys):
    last = run(tmp_path / "run", scans, *RUN, "trainer.max_steps=1")
    out = capsys.readouterr().out
    assert "trainer.max_steps=1 is reached within an epoch" in out and "100 %" not in out
    with pytest.warns(UserWarning, match="stopped within epoch 1, after 1 batches"):
        run(tmp_path / "again", scans, f"ckpt={last}", "trainer.max_steps=-1")


@pytest.mark.slow
def test_checkpoint_from_within_an_epoch_resumes_there(scans, tmp_path, recwarn):
    of_steps = [
        "+callbacks.steps._target_=lightning.pytorch.callbacks.ModelCheckpoint", "+callbacks.steps.filename=step",
        f"+callbacks.steps.dirpath={tmp_path}", "+callbacks.steps.every_n_train_steps=1", "trainer.max_steps=3",
    ]  # fmt: skip
    run(tmp_path / "run", scans, *RUN, *of_steps)
    within = tmp_path / "within" / "step.ckpt"
    within.parent.mkdir()
    (tmp_path / "step.ckpt").rename(within)
    run(tmp_path / "again", scans, f"ckpt={within}", "trainer.max_steps=-1")
    assert not [str(w.message) for w in recwarn if "stopped within" in str(w.message)]
    assert [step for step, _ in curves(tmp_path / "again")["train/loss_step"]] == [3]


@pytest.mark.slow
def test_resuming_is_refused_without_time_left(scans, tmp_path, capsys):
    last = run(tmp_path / "run", scans, *RUN[:-2], "trainer.max_epochs=-1", "trainer.max_time=00:00:00:01")
    assert "trainer.max_time is reached" in capsys.readouterr().out
    with pytest.raises(SystemExit):
        run(tmp_path / "again", scans, f"ckpt={last}", "trainer.max_time=00:00:00:01")
    assert "all of trainer.max_time" in capsys.readouterr().err


def test_data_root_is_that_of_this_machine(checkpoint, tmp_path, monkeypatch):
    content = torch.load(checkpoint, weights_only=True)
    content["hyper_parameters"]["trained_on"]["data"]["root"] = "/home/alice/data"  # older checkpoints store it
    torch.save(content, tmp_path / "old.ckpt")
    monkeypatch.setenv("LIDARLEARN_DATA", "/home/bob")
    assert composed(tmp_path / "o", checkpoint, program="evaluate").data.root == "/home/bob/folder"
    assert composed(tmp_path / "o", tmp_path / "old.ckpt").data.root == "/home/bob/folder"
    assert composed(tmp_path / "o", checkpoint, "data.root=/mine").data.root == "/mine"


RUN_FOLDER = "lidarlearn.commands.run_folder"
FOREIGN = {"_target_": f"{RUN_FOLDER}.git_revision"}


@pytest.mark.parametrize("command", [train, evaluate])
@pytest.mark.parametrize(
    ("part", "evil", "message"),
    [
        ("data", {"_target_": f"{RUN_FOLDER}._git", "_args_": ["-c", "alias.x=!touch PWNED", "x"]}, "_git"),
        ("data_name", "../../somewhere", "not a valid name of a data set"),
        ("data_name", "${oc.env:HOME}", "not a valid name of a data set"),
    ],
)
def test_untrusted_checkpoint_runs_no_code(checkpoint, tmp_path, monkeypatch, capsys, command, part, evil, message):
    content = torch.load(checkpoint, weights_only=True)
    content["hyper_parameters"]["trained_on"][part] = evil
    torch.save(content, tmp_path / "evil.ckpt")
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "argv", ["x.py", f"ckpt={tmp_path}/evil.ckpt", f"hydra.run.dir={tmp_path}/evil"])
    with pytest.raises(SystemExit):
        command.main()
    error = capsys.readouterr().err
    assert message in error and "change: " in error
    assert not list(tmp_path.rglob("PWNED"))


@pytest.mark.parametrize(
    ("keys", "value"),
    [
        (("hyper_parameters", "trained_on", "settings"), {"datamodule": {"augmentation": FOREIGN}}),
        (("hyper_parameters", "trained_on", "settings"), {"trainer": {"precision": FOREIGN}}),
        (("hyper_parameters", "trained_on", "settings"), {"seed": "${oc.env:HOME}"}),
        *((("hyper_parameters", part), FOREIGN) for part in ("model", "loss", "optimizer", "scheduler")),
        (("module",), FOREIGN["_target_"]),
    ],
)
def test_untrusted_part_or_setting_is_refused(checkpoint, tmp_path, keys, value):
    content = torch.load(checkpoint, weights_only=True)
    *places, key = keys
    functools.reduce(operator.getitem, places, content)[key] = value
    torch.save(content, tmp_path / "evil.ckpt")
    with pytest.raises(UntrustedTargetError):
        composed(tmp_path / "o", tmp_path / "evil.ckpt")
