"""Checks that a training can be resumed from a checkpoint."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from lightning.pytorch import Trainer
from lightning.pytorch.callbacks import Timer
from lightning.pytorch.utilities import rank_zero_warn

from lidarlearn.errors import UserError
from lidarlearn.training.checkpoints import load_checkpoint
from lidarlearn.training.module import PoseNetModule
from lidarlearn.training.parts import PARTS, argument
from lidarlearn.training.progress import time_left_s


def require_resumable(path: Path, module: PoseNetModule, trainer: Trainer) -> None:
    """Raise a `UserError` unless a training can be resumed; warn if the rest of an interrupted epoch is skipped.

    Args:
        path: the checkpoint.
        module: of the training to be resumed.
        trainer: its limits count from the very first start.
    """
    checkpoint = load_checkpoint(path)
    for part in PARTS:
        _require_unchanged(path, part, checkpoint["hyper_parameters"][part], module.hparams[part])
    loop = checkpoint["loops"]["fit_loop"]
    epochs, batches = loop["epoch_progress"]["current"], loop["epoch_loop.batch_progress"]
    epoch_is_closed = epochs["processed"] == epochs["started"]  # otherwise training continues within this epoch
    _require_below_limit(path, "epochs", checkpoint["epoch"] + epoch_is_closed, trainer.max_epochs)
    _require_below_limit(path, "steps", checkpoint["global_step"], trainer.max_steps)
    _require_time_left(path, checkpoint, trainer)
    if epoch_is_closed and not batches["is_last_batch"]:
        rank_zero_warn(
            f"ckpt={path} was stopped within epoch {checkpoint['epoch'] + 1}, after {batches['current']['processed']} "
            "batches: training continues with the next epoch, the remaining batches of this one are skipped"
        )


def _require_unchanged(path: Path, part: str, was: Mapping[str, Any], now: Mapping[str, Any]) -> None:
    values = {key: (argument(was, key), argument(now, key)) for key in {**was, **now}}
    changed = [f"{key} was {before} and is {after}" for key, (before, after) in values.items() if before != after]
    if changed:
        raise UserError(
            f"ckpt={path} cannot be resumed with another {part}: {', '.join(changed)}\n"
            f"  change: leave the settings of the {part} to the checkpoint, or train from the start, without ckpt"
        )


def _require_below_limit(path: Path, unit: str, done: int, limit: int | None) -> None:
    """None and negative limits stand for no limit."""
    if limit is not None and 0 <= limit <= done:
        raise UserError(
            f"ckpt={path} has already seen {done} of {limit} {unit}\n  change: trainer.max_{unit}={2 * done}"
        )


def _require_time_left(path: Path, checkpoint: Mapping[str, Any], trainer: Trainer) -> None:
    elapsed_s = checkpoint["callbacks"].get(Timer.__qualname__, {}).get("time_elapsed", {}).get("train", 0.0)
    left_s = time_left_s(trainer)
    if left_s is not None and left_s <= elapsed_s:
        raise UserError(
            f"ckpt={path} has already been trained for {elapsed_s:.0f} s, which is all of trainer.max_time\n"
            "  change: trainer.max_time, which counts from the first start"
        )
