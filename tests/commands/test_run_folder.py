"""The lock of a run folder, and the digest of the code behind a result."""

import sys

import pytest

from lidarlearn.commands import evaluation
from lidarlearn.commands.run_folder import code_digest, held_run_folder
from lidarlearn.errors import UserError
from lidarlearn.source_digest import source_digest
from tests.commands.configs import composed_with_hydra
from tests.commands.scans import configured


@pytest.fixture
def training(tmp_path):
    """The folder of a training."""
    (tmp_path / "checkpoints").mkdir()
    (tmp_path / "checkpoints" / "best.ckpt").touch()
    (tmp_path / "config.yaml").write_text("lr: 1\n")
    return tmp_path


def is_unchanged(training):
    return (
        sorted(path.name for path in training.iterdir()) == ["checkpoints", "config.yaml"]
        and (training / "config.yaml").read_text() == "lr: 1\n"
    )


def test_evaluation_into_training_folder_is_refused(call, training, capsys):
    with pytest.raises(SystemExit):
        call(f"hydra.run.dir={training}", "methods=[ni]", "data.test_sequences=['0']")
    error = capsys.readouterr().err
    assert f"{training} holds a training" in error and f"hydra.run.dir={training}/evaluation" in error
    assert is_unchanged(training)


def test_convergence_into_training_folder_is_refused(scans, training):
    with pytest.raises(UserError, match=f"{training} holds a training"):
        evaluation.measure_convergence(configured("convergence", scans, training))
    assert is_unchanged(training)


def test_run_folder_is_locked_during_evaluation(call, tmp_path, capsys):
    with held_run_folder(tmp_path), pytest.raises(SystemExit):
        call(f"hydra.run.dir={tmp_path}", "methods=[ni]")
    error = capsys.readouterr().err
    assert f"{tmp_path}: another process writes its results there" in error and "hydra.run.dir=" in error
    with held_run_folder(tmp_path):
        assert not (tmp_path / "results.json").exists()


@pytest.mark.parametrize("program", ["train", "evaluate", "convergence"])
def test_simultaneous_runs_get_different_folders(program):
    one, two = composed_with_hydra(program).hydra, composed_with_hydra.__wrapped__(program).hydra  # the latter anew
    folders = [one.run.dir, two.run.dir, one.sweep.dir, two.sweep.dir]  # Hydra reads the time once, at first access
    assert folders[0] < folders[1] and folders[2] < folders[3]
    assert all(folder.startswith(f"outputs/{program}/") for folder in folders)


@pytest.fixture
def own_class(tmp_path, monkeypatch):
    """The file of a class outside of the package, which may be edited between digests."""
    monkeypatch.syspath_prepend(tmp_path)
    source_digest.cache_clear()
    yield tmp_path / "my_part.py"
    sys.modules.pop("my_part", None)
    source_digest.cache_clear()


@pytest.mark.parametrize(
    "settings",
    [{"_target_": "my_part.Part"}, {"odometry": {"steps": [{"_target_": "my_part.Part", "size": 1}]}}],
)
def test_code_digest_covers_classes_outside_the_package(own_class, settings):
    digests = []
    for size in (1, 2):
        own_class.write_text(f"class Part:\n    size = {size}\n")
        source_digest.cache_clear()
        digests.append(code_digest(settings))
    assert len({*digests, code_digest()}) == 3


def test_code_digest_is_that_of_the_package_for_its_own_classes():
    assert (
        code_digest({"_target_": "lidarlearn.odometry.initialization.NoInitialization"}, {"size": 1}) == code_digest()
    )


def test_code_digest_names_missing_class():
    with pytest.raises(UserError, match=r"my_nowhere\.Part"):
        code_digest({"_target_": "my_nowhere.Part"})
