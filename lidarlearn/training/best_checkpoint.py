"""The best checkpoint of a whole training, also of one that was resumed."""

import shutil
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from lightning.pytorch import LightningModule, Trainer
from lightning.pytorch.callbacks import ModelCheckpoint
from lightning.pytorch.utilities import rank_zero_warn

from lidarlearn.training.checkpoints import load_checkpoint
from lidarlearn.training.module import PoseNetModule

_ERROR, _KIND = "best_error", "best_error_is"  # in a checkpoint, beside what Lightning keeps
_OF_POSES, _MISFIT = "of poses", "misfit"
_NO_MATTER_OF_VALIDATION = ("root", "train_sequences", "test_sequences", "deskew", "workers")  # among the data's


class BestCheckpoint(ModelCheckpoint):
    """Keeps the epoch with the smallest validation error as `best.ckpt`.

    A training that goes on in another folder begins with the best checkpoint beside the one it was resumed from, and
    its error. Where it validates in another way, errors do not compare: the best is chosen anew, and the one before
    is kept under another name.

    Args:
        dirpath: folder of the checkpoint.
        monitor: what is smallest in the best epoch.
    """

    def __init__(self, dirpath: str, monitor: str = "val/error") -> None:
        super().__init__(dirpath, "best", monitor=monitor, save_on_train_epoch_end=True, enable_version_counter=False)

    def on_save_checkpoint(self, trainer: Trainer, pl_module: LightningModule, checkpoint: dict[str, Any]) -> None:
        """Tell the smallest error so far."""
        checkpoint[_ERROR], checkpoint[_KIND] = self.best_model_score, _kind(pl_module)

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        """Leave out what Lightning would take over: the file may have been moved, or be of a later epoch."""

    def on_train_start(self, trainer: Trainer, pl_module: LightningModule) -> None:
        """Take over the best checkpoint so far."""
        super().on_train_start(trainer, pl_module)
        if not trainer.ckpt_path:
            return
        found = Path(trainer.ckpt_path).with_name("best.ckpt")
        if not found.is_file():
            return
        best = load_checkpoint(found)
        here = Path(str(self.dirpath)) / found.name
        reason = _why_not_comparable(best, trainer, pl_module)
        trainer.strategy.barrier()  # every process has read the file before it moves
        if reason is None:
            self._take_over(trainer, found, here, best[_ERROR])
        elif here.is_file():
            kept = here.with_name(f"best_before_epoch_{trainer.current_epoch + 1:03d}.ckpt")
            rank_zero_warn(f"{here} {reason}: the best is chosen anew, and the file is now called {kept.name}")
            if trainer.is_global_zero:
                here.replace(kept)

    def _take_over(self, trainer: Trainer, found: Path, here: Path, error: Any) -> None:
        if trainer.is_global_zero and not (here.exists() and here.samefile(found)):
            here.parent.mkdir(parents=True, exist_ok=True)
            shutil.copyfile(found, here)
        self.best_model_path = self.kth_best_model_path = str(here)
        self.best_model_score = self.kth_value = error
        self.best_k_models = {str(here): error}


def _why_not_comparable(best: Mapping[str, Any], trainer: Trainer, pl_module: LightningModule) -> str | None:
    """Why a checkpoint is not the best one so far of a training that begins, None where it is."""
    if best.get(_ERROR) is None:
        return "does not tell its error"
    if best["epoch"] >= trainer.current_epoch:
        return f"is of epoch {best['epoch'] + 1}, after the one that goes on"
    was, now = (_validation(parts["trained_on"]) for parts in (best["hyper_parameters"], pl_module.hparams))
    # earlier versions told no kind: where there was no ground truth it was the loss
    was, now = {**was, "error": best.get(_KIND, _OF_POSES)}, {**now, "error": _kind(pl_module)}
    changed = [key for key in {**was, **now} if was.get(key) != now.get(key)]
    return f"was validated in another way ({', '.join(changed)})" if changed else None


def _kind(module: LightningModule) -> str:
    """What the validation error is, see `PoseNetModule.on_validation_epoch_end`."""
    assert isinstance(module, PoseNetModule)
    has_truth = any(sequence.T_world_lidar is not None for sequence in module.val_sequences)
    return _OF_POSES if has_truth else _MISFIT


def _validation(trained_on: Mapping[str, Any]) -> dict[str, Any]:
    """Settings that decide about the validation error."""
    data = {f"data.{key}": value for key, value in trained_on["data"].items() if key not in _NO_MATTER_OF_VALIDATION}
    batches = trained_on.get("settings", {}).get("trainer", {}).get("limit_val_batches")
    return {**data, "image": trained_on["projection"], "trainer.limit_val_batches": batches}
