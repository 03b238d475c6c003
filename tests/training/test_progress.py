"""The progress of a training, on a terminal and in a log file."""

import re
from unittest.mock import create_autospec

import pytest
import torch
from lightning.pytorch import LightningModule, Trainer
from torch._subclasses.fake_tensor import FakeTensorMode

from lidarlearn.training.progress import ProgressLines


@pytest.fixture
def trainer():
    metrics = {
        "train/loss_epoch": torch.tensor(0.125),
        "val/avg_translation_error_percent": torch.tensor(3.456),
        "val/mean_relative_translation_error_m": torch.tensor(0.0789),
    }
    stand_in = create_autospec(Trainer, instance=True)
    stand_in.current_epoch = 0
    stand_in.accumulate_grad_batches = 1
    stand_in.max_epochs, stand_in.num_training_batches, stand_in.callback_metrics = 2, 4, metrics
    return stand_in


def run(bar, trainer):
    module = LightningModule()
    bar.on_train_start(trainer, module)
    for epoch in range(2):
        trainer.current_epoch = epoch
        bar.on_train_epoch_start(trainer, module)
        for i in range(4):
            bar.on_train_batch_end(trainer, module, {"loss": torch.tensor(0.5)}, None, i)
        if epoch == 0:
            bar.on_validation_end(trainer, module)
        bar.on_train_epoch_end(trainer, module)


def test_log_file_gets_one_line_per_epoch(trainer, capsys):
    run(ProgressLines(seconds_between_lines=1000.0), trainer)
    lines = capsys.readouterr().out.splitlines()
    assert len(lines) == 2
    assert re.match(r"epoch 1/2 \[#{20}\] 100 %  loss 0\.125", lines[0])
    assert "3.46 %" in lines[0] and "0.079 m" in lines[0]
    assert lines[1].startswith("epoch 2/2") and "left" not in lines[1]
    assert "3.46 %" not in lines[1]  # not validated in this epoch


def test_error_without_percentage_is_printed_in_metres(trainer, capsys):
    del trainer.callback_metrics["val/avg_translation_error_percent"]
    run(ProgressLines(seconds_between_lines=1000.0), trainer)
    assert re.search(r" 100 %  loss 0\.125  relative translation error 0\.079 m  \d", capsys.readouterr().out)


def test_error_is_also_printed_as_share_of_motion(trainer, capsys):
    trainer.callback_metrics["val/mean_relative_translation_error_percent"] = torch.tensor(5.43)
    run(ProgressLines(seconds_between_lines=1000.0), trainer)
    assert "  relative translation error 0.079 m  = 5.4 % of motion  " in capsys.readouterr().out


def test_long_epoch_prints_intermediate_lines(trainer, capsys):
    run(ProgressLines(seconds_between_lines=0.0), trainer)
    lines = capsys.readouterr().out.splitlines()
    shares = [int(re.search(r"(\d+) %", line)[1]) for line in lines]
    assert shares == [25, 50, 75, 100, 25, 50, 75, 100]
    assert all("loss 0.5" in line for line in lines[:3])


def test_printed_loss_undoes_gradient_accumulation(trainer, capsys):
    trainer.accumulate_grad_batches = 4  # Lightning divides each loss by four
    run(ProgressLines(seconds_between_lines=0.0), trainer)
    assert "loss 2 " in capsys.readouterr().out.splitlines()[0]


def test_loss_is_read_from_device_only_when_printed(trainer):
    bar, module = ProgressLines(seconds_between_lines=1000.0), LightningModule()
    bar.on_train_start(trainer, module)
    bar.on_train_epoch_start(trainer, module)
    with FakeTensorMode():  # its tensors have no values
        for i in range(4):
            bar.on_train_batch_end(trainer, module, {"loss": torch.ones(()) * 0.5}, None, i)


def test_terminal_gets_a_moving_bar(trainer, capsys, monkeypatch):
    monkeypatch.setattr("sys.stdout.isatty", lambda: True, raising=False)
    run(ProgressLines(), trainer)
    out = capsys.readouterr().out
    assert out.count("\n") == 2 and out.count("\r") >= 2


def test_disabled_progress_prints_nothing(trainer, capsys):
    bar = ProgressLines(0.0)
    bar.disable()
    run(bar, trainer)
    assert capsys.readouterr().out == ""


def test_remaining_time_after_resuming_uses_pace_since_start(trainer, capsys, monkeypatch):
    """Resumed in the ninth epoch of eleven."""
    now = [0.0]
    monkeypatch.setattr("lidarlearn.training.progress.time.monotonic", lambda: now[0])
    trainer.current_epoch, trainer.max_epochs = 8, 11
    bar, module = ProgressLines(seconds_between_lines=1000.0), LightningModule()
    bar.on_train_start(trainer, module)
    bar.on_train_epoch_start(trainer, module)
    now[0] = 60.0
    bar.on_train_batch_end(trainer, module, {"loss": torch.tensor(0.5)}, None, 3)
    bar.on_train_epoch_end(trainer, module)
    assert capsys.readouterr().out.endswith("1 min 00 s  2 min 00 s left\n")
