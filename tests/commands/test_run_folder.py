"""What runs leave in their folders beside the results."""

import sys

import pytest

from lidarlearn.commands import evaluation
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
