"""Progress of a training, on a terminal and in a log file."""

import sys
import time
from typing import Any

import torch
from lightning.pytorch import LightningModule, Trainer
from lightning.pytorch.callbacks import Timer
from lightning.pytorch.callbacks.progress import ProgressBar
from torch import Tensor

_BAR = 20  # characters


class ProgressLines(ProgressBar):
    """A bar with the loss and the time left, and a permanent line for each epoch.

    On a terminal the bar moves in place. A file or a pipe gets a line every now and then, so that a log stays readable.

    Args:
        seconds_between_lines: least time between two lines within an epoch if the output is not a terminal [s].
    """

    def __init__(self, seconds_between_lines: float = 30.0) -> None:
        super().__init__()
        self.seconds_between_lines = seconds_between_lines
        self._enabled = True
        self._loss = torch.tensor(float("nan"))
        self._epoch_started = self._fit_started = self._last_shown = 0.0
        self._first_epoch = 0
        self._share = 0.0  # of the epoch's batches
        self._is_validated = False

    def disable(self) -> None:
        """Show nothing; Lightning calls this in all processes but the first."""
        self._enabled = False

    def enable(self) -> None:
        """Show progress again."""
        self._enabled = True

    def on_train_start(self, trainer: Trainer, pl_module: LightningModule) -> None:
        """Start the clock."""
        self._fit_started = time.monotonic()
        self._first_epoch = trainer.current_epoch

    def on_train_epoch_start(self, trainer: Trainer, pl_module: LightningModule) -> None:
        """Start the clock of the epoch."""
        self._share, self._is_validated = 0.0, False
        self._epoch_started = self._last_shown = time.monotonic()
        self._loss = torch.tensor(float("nan"))

    def on_train_batch_end(
        self, trainer: Trainer, pl_module: LightningModule, outputs: Any, batch: Any, batch_idx: int
    ) -> None:
        """Move the bar."""
        # stays a tensor until it is shown: converting it to a number waits for the device
        loss = (outputs["loss"] if isinstance(outputs, dict) else outputs).detach()
        loss = loss * trainer.accumulate_grad_batches  # Lightning has divided by it
        self._share = (batch_idx + 1) / max(1, trainer.num_training_batches)
        self._loss = loss if batch_idx == 0 else 0.95 * self._loss + 0.05 * loss
        terminal = sys.stdout.isatty()
        ends = batch_idx + 1 >= trainer.num_training_batches and not terminal  # the line of the epoch follows
        if not ends and time.monotonic() - self._last_shown >= (0.1 if terminal else self.seconds_between_lines):
            self._last_shown = time.monotonic()
            self._show(f"{self._head(trainer)}  loss {float(self._loss):.4g}  {self._left(trainer)}", terminal)

    def on_validation_end(self, trainer: Trainer, pl_module: LightningModule) -> None:
        """Remember that the logged errors are from this epoch."""
        self._is_validated = True

    def on_train_epoch_end(self, trainer: Trainer, pl_module: LightningModule) -> None:
        """Print a line with the mean loss of the epoch and, if it was validated, its error."""
        metrics = trainer.callback_metrics
        loss = float(metrics.get("train/loss_epoch", self._loss))
        took = _duration(time.monotonic() - self._epoch_started)
        errors = _errors(metrics) if self._is_validated else []
        parts = [self._head(trainer), f"loss {loss:.4g}", *errors, took, self._left(trainer)]
        self._show("  ".join(part for part in parts if part), in_place=False)

    def on_train_end(self, trainer: Trainer, pl_module: LightningModule) -> None:
        """Print what ended the training before its last epoch."""
        within = "" if self._share >= 1 else " within an epoch"
        left = time_left_s(trainer)
        if left is not None and left <= 0:
            self._show(f"trainer.max_time is reached{within}", in_place=False)
        elif 0 < trainer.max_steps <= trainer.global_step:
            self._show(f"trainer.max_steps={trainer.max_steps} is reached{within}", in_place=False)
        elif trainer.should_stop:  # otherwise their reason is that of an earlier training, which this one resumes
            for callback in trainer.early_stopping_callbacks:
                if callback.stopping_reason_message:
                    self._show(f"EarlyStopping: {callback.stopping_reason_message}", in_place=False)

    def _head(self, trainer: Trainer) -> str:
        share = self._share
        filled = round(_BAR * min(share, 1.0))
        last = trainer.max_epochs if trainer.max_epochs and trainer.max_epochs > 0 else "?"
        bar = "#" * filled + "-" * (_BAR - filled)
        return f"epoch {trainer.current_epoch + 1:>{len(str(last))}}/{last} [{bar}] {100 * min(share, 1.0):3.0f} %"

    def _left(self, trainer: Trainer) -> str:
        """Time left at the mean pace since this start."""
        done = trainer.current_epoch - self._first_epoch + self._share
        if not trainer.max_epochs or trainer.max_epochs < 0 or done <= 0:
            return ""
        left = (time.monotonic() - self._fit_started) / done * (trainer.max_epochs - self._first_epoch - done)
        return f"{_duration(left)} left" if left > 0.5 else ""

    def _show(self, text: str, in_place: bool) -> None:
        if self._enabled:
            start, end = ("\r\x1b[K", "" if in_place else "\n") if sys.stdout.isatty() else ("", "\n")
            print(start + text, end=end, flush=True)


def time_left_s(trainer: Trainer) -> float | None:
    """Seconds left of `trainer.max_time`; None without such a limit."""
    callbacks = trainer.callbacks  # type: ignore[attr-defined]  # Lightning sets it without declaring it
    timers = (callback for callback in callbacks if isinstance(callback, Timer))
    return min((left for timer in timers if (left := timer.time_remaining()) is not None), default=None)


def _errors(metrics: dict[str, Tensor]) -> list[str]:
    """The most informative validation errors, with their units."""
    shown = {
        "val/avg_translation_error_percent": "avg translation error {:.2f} %",
        "val/mean_relative_translation_error_m": "relative translation error {:.3f} m",
        "val/mean_relative_translation_error_percent": "= {:.1f} % of motion",  # missing if nothing moves
        "val/misfit": "misfit {:.3f}",
    }
    return [form.format(float(metrics[name])) for name, form in shown.items() if name in metrics]


def _duration(seconds: float) -> str:
    minutes, rest = divmod(round(seconds), 60)
    hours, minutes = divmod(minutes, 60)
    if hours:
        return f"{hours} h {minutes:02d} min"
    return f"{minutes} min {rest:02d} s" if minutes else f"{rest} s"
