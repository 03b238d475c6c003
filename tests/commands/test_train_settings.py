"""Settings that contradict each other are refused before data are prepared."""

import pytest

from lidarlearn.commands.train import train
from lidarlearn.errors import UserError
from tests.training.runs import configured


@pytest.mark.parametrize(
    ("overrides", "remedy"),
    [
        (["trainer.precision=bf16-mixed", "trainer.gradient_clip_val=1.0"], r"optimizer\.fused=false"),
        (["trainer.precision=bf16-true"], r"trainer\.precision to one of .*bf16-mixed"),
        (["trainer.logger=false"], "~callbacks.learning_rate"),
        (["trainer.enable_checkpointing=false"], "~callbacks.last_checkpoint ~callbacks.best_checkpoint$"),
        (["trainer.enable_checkpointing=false", "~callbacks.best_checkpoint"], "add ~callbacks.last_checkpoint$"),
        (["trainer.max_epochs=-1", "scheduler=cosine"], r"trainer\.max_epochs"),
        (["trainer.max_epochs=null", "trainer.max_time=00:01:00:00", "scheduler=cosine"], r"trainer\.max_epochs"),
        (["trainer.val_check_interval=2"], r"trainer\.check_val_every_n_epoch"),
        (["scheduler=cosin"], "choose one of step, cosine, constant"),
    ],
)
def test_contradicting_settings_are_refused_with_a_remedy(tmp_path, overrides, remedy):
    with pytest.raises(UserError, match=remedy):
        train(configured(tmp_path / "run", *overrides), data_name="boxes")


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore::DeprecationWarning:tensorboard")
@pytest.mark.parametrize(
    "overrides",
    [
        ["trainer.precision=bf16-mixed", "trainer.gradient_clip_val=1.0", "optimizer.fused=false"],
        ["trainer.logger=false", "~callbacks.learning_rate"],
        ["trainer.enable_checkpointing=false", "~callbacks.last_checkpoint", "~callbacks.best_checkpoint"],
    ],
)
def test_settings_changed_as_advised_work(tmp_path, overrides):
    train(configured(tmp_path / "run", *overrides, "trainer.max_epochs=1", frames=9), data_name="boxes")
