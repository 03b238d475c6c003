"""Whether and how a training can go on from a checkpoint."""

from pathlib import Path

from lightning.pytorch import Trainer
from lightning.pytorch.callbacks import Timer
from lightning.pytorch.utilities import rank_zero_warn

from lidarlearn.errors import UserError
from lidarlearn.training.checkpoints import load_checkpoint
from lidarlearn.training.module import PoseNetModule
from lidarlearn.training.parts import argument
from lidarlearn.training.progress import time_left_s

_FIXED = ("model", "loss", "optimizer", "scheduler")


def require_resumable(path: Path, module: PoseNetModule, trainer: Trainer) -> None:
    """Raise a `UserError` where a training cannot go on from a checkpoint, and warn where it goes on elsewhere.

    Args:
        path: the checkpoint.
        module: of the training that is to go on, as its trainer.
        trainer: whose limits count from the very first start.
    """
    checkpoint = load_checkpoint(path)
    for part in _FIXED:
        was, now = checkpoint["hyper_parameters"][part], module.hparams[part]
        values = {key: (argument(was, key), argument(now, key)) for key in {**was, **now}}
        changed = [f"{key} was {before} and is {after}" for key, (before, after) in values.items() if before != after]
        if changed:
            raise UserError(
                f"ckpt={path} does not go on with another {part}: {', '.join(changed)}\n"
                f"  change: leave the settings of the {part} to the checkpoint, or train from the start, without ckpt"
            )
    loop = checkpoint["loops"]["fit_loop"]
    epochs, batches = loop["epoch_progress"]["current"], loop["epoch_loop.batch_progress"]
    is_closed = epochs["processed"] == epochs["started"]  # the epoch; else training goes on within it
    for what, done, most in (
        ("epochs", checkpoint["epoch"] + is_closed, trainer.max_epochs),
        ("steps", checkpoint["global_step"], trainer.max_steps),
    ):
        if most is not None and 0 <= most <= done:
            raise UserError(
                f"ckpt={path} has already seen {done} of {most} {what}\n  change: trainer.max_{what}={2 * done}"
            )
    clock = checkpoint["callbacks"].get(Timer.__qualname__, {}).get("time_elapsed", {}).get("train", 0.0)
    left = time_left_s(trainer)
    if left is not None and left <= clock:
        raise UserError(
            f"ckpt={path} has already been trained for {clock:.0f} s, which is all of trainer.max_time\n"
            "  change: trainer.max_time, which counts from the first start"
        )
    if is_closed and not batches["is_last_batch"]:
        rank_zero_warn(
            f"ckpt={path} was stopped within epoch {checkpoint['epoch'] + 1}, after {batches['current']['processed']} "
            "batches: training goes on with the next epoch, and the others of this one are left out"
        )
