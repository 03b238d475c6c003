"""What runs leave in their folders beside the results."""

import sys

import pytest
from hydra import compose, initialize_config_dir

from lidarlearn.commands import evaluation
from lidarlearn.commands.configs import config_directory
from lidarlearn.commands.run_folder import code_digest, held_run_folder
from lidarlearn.errors import UserError
from lidarlearn.source_digest import source_digest
from tests.commands.scans import SENSOR


@pytest.fixture
def training(tmp_path):
    """The folder of a training."""
    (tmp_path / "checkpoints").mkdir()
    (tmp_path / "checkpoints" / "best.ckpt").touch()
    (tmp_path / "config.yaml").write_text("lr: 1\n")
    return tmp_path


def kept(training):
    return (
        sorted(path.name for path in training.iterdir()) == ["checkpoints", "config.yaml"]
        and (training / "config.yaml").read_text() == "lr: 1\n"
    )


def test_a_training_keeps_its_folder_to_itself(call, training, capsys):
    with pytest.raises(SystemExit):
        call(f"hydra.run.dir={training}", "methods=[ni]", "data.test_sequences=['0']")
    error = capsys.readouterr().err
    assert f"{training} holds a training" in error and f"hydra.run.dir={training}/evaluation" in error
    assert kept(training)


def test_basins_are_not_measured_into_a_training_either(scans, training, monkeypatch, capsys):
    own = ["data=folder", f"data.root={scans}", *SENSOR, "data.test_sequences=['0']", f"hydra.run.dir={training}"]
    monkeypatch.setattr(sys, "argv", ["x", "convergence", *own])
    with pytest.raises(SystemExit):
        evaluation.main()
    assert f"{training} holds a training" in capsys.readouterr().err and kept(training)


def test_two_evaluations_do_not_write_into_one_folder_at_once(call, no_plots, tmp_path, capsys):
    own = [f"hydra.run.dir={tmp_path}", "methods=[ni]", "data.test_sequences=['0']"]
    with held_run_folder(tmp_path), pytest.raises(SystemExit):
        call(*own)
    error = capsys.readouterr().err
    assert f"{tmp_path}: another process writes its results there" in error and "hydra.run.dir=" in error
    call(*own)
    assert (tmp_path / "results.json").is_file()


@pytest.mark.parametrize("program", ["train", "evaluate", "convergence"])
def test_runs_that_start_at_once_have_a_folder_each(program):
    with initialize_config_dir(str(config_directory()), version_base="1.3"):
        one, two = (compose(program, return_hydra_config=True).hydra for _ in range(2))
    folders = [one.run.dir, two.run.dir, one.sweep.dir, two.sweep.dir]  # the time is that of the first look
    assert folders[0] < folders[1] and folders[2] < folders[3]
    assert all(folder.startswith(f"outputs/{program}/") for folder in folders)


@pytest.fixture
def own_class(tmp_path, monkeypatch):
    """A class outside of the package, whose file may be edited before it is digested again."""
    monkeypatch.syspath_prepend(tmp_path)
    source_digest.cache_clear()
    yield tmp_path / "my_part.py"
    sys.modules.pop("my_part", None)
    source_digest.cache_clear()


@pytest.mark.parametrize(
    "settings",
    [{"_target_": "my_part.Part"}, {"odometry": {"steps": [{"_target_": "my_part.Part", "size": 1}]}}],
)
def test_the_code_of_a_result_is_the_package_s_and_that_of_the_user_s_classes(own_class, settings):
    digests = []
    for size in (1, 2):
        own_class.write_text(f"class Part:\n    size = {size}\n")
        source_digest.cache_clear()
        digests.append(code_digest(settings))
    assert len({*digests, code_digest()}) == 3


def test_settings_of_the_package_alone_leave_the_code_as_it_is():
    assert (
        code_digest({"_target_": "lidarlearn.odometry.initialization.NoInitialization"}, {"size": 1}) == code_digest()
    )


def test_a_class_that_is_not_there_is_named():
    with pytest.raises(UserError, match=r"my_nowhere\.Part"):
        code_digest({"_target_": "my_nowhere.Part"})
