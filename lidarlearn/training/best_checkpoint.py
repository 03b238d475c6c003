"""The best checkpoint of a training, carried over when the training is resumed."""

import shutil
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from lightning.pytorch import LightningModule, Trainer
from lightning.pytorch.callbacks import ModelCheckpoint
from lightning.pytorch.utilities import rank_zero_warn

from lidarlearn.training.checkpoints import load_checkpoint
from lidarlearn.training.module import PoseNetModule

_ERROR, _ERROR_KIND = "best_error", "best_error_is"  # keys in a checkpoint, beside Lightning's own
_OF_POSES, _MISFIT = "of poses", "misfit"
_IRRELEVANT_TO_VALIDATION = ("root", "train_sequences", "test_sequences", "deskew", "workers")  # settings of the data


class BestCheckpoint(ModelCheckpoint):
    """Keeps the epoch with the smallest validation error as `best.ckpt`.

    A resumed training starts with the `best.ckpt` beside the checkpoint it resumes from, even if it writes to another
    folder. If it is validated differently, for example on other sequences, the errors cannot be compared: it selects a
    new best checkpoint and renames the old one.

    Args:
        dirpath: folder of the checkpoint.
        monitor: the logged quantity to minimize.
    """

    def __init__(self, dirpath: str, monitor: str = "val/error") -> None:
        super().__init__(dirpath, "best", monitor=monitor, save_on_train_epoch_end=True, enable_version_counter=False)

    def on_save_checkpoint(self, trainer: Trainer, pl_module: LightningModule, checkpoint: dict[str, Any]) -> None:
        """Store the smallest error so far, and what kind of error it is."""
        checkpoint[_ERROR], checkpoint[_ERROR_KIND] = self.best_model_score, _error_kind(pl_module)

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        """Ignore Lightning's state: the best checkpoint it names may have been moved, or be from a later epoch."""

    def on_train_start(self, trainer: Trainer, pl_module: LightningModule) -> None:
        """Carry over the best checkpoint so far."""
        super().on_train_start(trainer, pl_module)
        if not trainer.ckpt_path:
            return
        previous = Path(trainer.ckpt_path).with_name("best.ckpt")
        if not previous.is_file():
            return
        checkpoint = load_checkpoint(previous)
        own = Path(str(self.dirpath)) / previous.name
        reason = _why_not_comparable(checkpoint, trainer, pl_module)
        trainer.strategy.barrier()  # every process has read the file before it is moved
        if reason is None:
            self._carry_over(trainer, previous, own, checkpoint[_ERROR])
        elif own.is_file():
            renamed = own.with_name(f"best_before_epoch_{trainer.current_epoch + 1:03d}.ckpt")
            rank_zero_warn(f"{own} {reason}: a new best checkpoint is selected, the old one is now {renamed.name}")
            if trainer.is_global_zero:
                own.replace(renamed)

    def _carry_over(self, trainer: Trainer, previous: Path, own: Path, error: Any) -> None:
        if trainer.is_global_zero and not (own.exists() and own.samefile(previous)):
            own.parent.mkdir(parents=True, exist_ok=True)
            shutil.copyfile(previous, own)
        self.best_model_path = self.kth_best_model_path = str(own)
        self.best_model_score = self.kth_value = error
        self.best_k_models = {str(own): error}


def _why_not_comparable(best: Mapping[str, Any], trainer: Trainer, pl_module: LightningModule) -> str | None:
    """Why the error of a best checkpoint cannot be compared with those of the resumed training; None if it can."""
    if best.get(_ERROR) is None:
        return "does not record its error"
    if best["epoch"] >= trainer.current_epoch:
        return f"is from epoch {best['epoch'] + 1}, which is later than the checkpoint to resume from"
    # Older checkpoints do not record the kind. Without ground truth their error was the loss, not the misfit.
    was = _validation_settings(best["hyper_parameters"]) | {"error": best.get(_ERROR_KIND, _OF_POSES)}
    now = _validation_settings(pl_module.hparams) | {"error": _error_kind(pl_module)}
    changed = [key for key in was | now if was.get(key) != now.get(key)]
    return f"was validated in another way ({', '.join(changed)})" if changed else None


def _error_kind(module: LightningModule) -> str:
    """What the validation error measures, see `PoseNetModule.on_validation_epoch_end`."""
    assert isinstance(module, PoseNetModule)
    has_truth = any(sequence.T_world_lidar is not None for sequence in module.val_sequences)
    return _OF_POSES if has_truth else _MISFIT


def _validation_settings(hyper_parameters: Mapping[str, Any]) -> dict[str, Any]:
    """The settings on which the validation error depends."""
    trained_on = hyper_parameters["trained_on"]
    data = {f"data.{key}": value for key, value in trained_on["data"].items() if key not in _IRRELEVANT_TO_VALIDATION}
    batches = trained_on.get("settings", {}).get("trainer", {}).get("limit_val_batches")
    return {**data, "image": trained_on["projection"], "trainer.limit_val_batches": batches}
