"""`python train.py`: train PoseNet on a data set, with or without ground truth."""

import shlex
import string
import sys
import tempfile
from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any, cast

from hydra.core.hydra_config import HydraConfig
from hydra.utils import instantiate
from lightning.pytorch import Trainer, seed_everything
from lightning.pytorch.utilities import rank_zero_only
from omegaconf import DictConfig, OmegaConf

import lidarlearn
from lidarlearn.commands import entry_point
from lidarlearn.commands.checkpoint_options import chosen_data, quoted
from lidarlearn.commands.device import resolve_device
from lidarlearn.commands.resume import add_settings, settings_to_keep
from lidarlearn.commands.run_folder import checkpoints_in, git_revision, write_run_description
from lidarlearn.data.datamodule import OdometryDataModule
from lidarlearn.errors import UserError
from lidarlearn.training.module import PoseNetModule
from lidarlearn.training.parts import TRUSTED_PACKAGES, build
from lidarlearn.training.quiet import quiet
from lidarlearn.training.resuming import require_resumable

_PRECISIONS = ("None", "32-true", "32", "bf16-mixed", "bf16", "16-mixed", "16")
_PLAIN_CHARACTERS = frozenset(string.ascii_letters + string.digits + "/._-:+")


def main() -> None:
    """Entry point of `train.py` and `lidarlearn-train`."""
    with tempfile.TemporaryDirectory() as folder:
        entry_point.run(_train_and_print_next_step, "train", lambda: add_settings(sys.argv, Path(folder)))


def train(config: DictConfig, data_name: str) -> Path:
    """Train as configured, from the start or from a checkpoint.

    Args:
        config: composed from `configs/train.yaml`.
        data_name: the chosen option of the group `data`, stored in the checkpoint.

    Returns:
        The best checkpoint by validation, or the last one without validation.

    Raises:
        UserError: the data, the checkpoint or a setting is invalid.
    """
    quiet()
    seed_everything(config.seed, workers=True, verbose=False)
    resolve_device(config)
    _require_workable(config)
    run_folder = Path(config.run_dir)
    trainer: Trainer = instantiate(config.trainer)
    if trainer.is_global_zero:  # the other processes may start after the first has written there
        _require_free(run_folder, config.ckpt)
    datamodule: OdometryDataModule = instantiate(config.datamodule)
    module = build_module(config, datamodule, data_name)
    if config.ckpt is not None:
        require_resumable(Path(config.ckpt), module, trainer)
    if trainer.is_global_zero:
        write_run_description(run_folder, config)
    trainer.fit(module, datamodule=datamodule, ckpt_path=config.ckpt)
    best = run_folder / "checkpoints" / "best.ckpt"
    return best if best.exists() else best.with_name("last.ckpt")


def command_with(
    checkpoint: Path,
    program: str,
    overrides: Sequence[str] = (),
    config_folder: str | None = None,
    is_data_stored: bool = True,
) -> str:
    """The command that evaluates or resumes a checkpoint, ready to be pasted into a shell.

    Args:
        checkpoint: the file.
        program: evaluate or train.
        overrides: overrides of its training. `data.root` is repeated, because a checkpoint does not store it.
        config_folder: a folder with options of the user, which its data may need.
        is_data_stored: whether the checkpoint can choose its data. If the class of the data set is not from a trusted
            package, it must not, and all overrides of the data are repeated.
    """
    path = str(checkpoint.relative_to(Path.cwd()) if checkpoint.is_relative_to(Path.cwd()) else checkpoint)
    if not _PLAIN_CHARACTERS.issuperset(path):
        path = quoted(path)  # for Hydra; the shell's quotes come around it
    start = f"python {program}.py" if Path(f"{program}.py").is_file() else f"lidarlearn-{program}"
    arguments = [] if config_folder is None else ["--config-dir", config_folder]  # first, so that more can be appended
    repeated = ("data.root=",) if is_data_stored else ("data=", "data.", "projection@data.")
    arguments += [f"ckpt={path}", *(override for override in overrides if override.startswith(repeated))]
    return f"{start} {shlex.join(arguments)}"


def _train_and_print_next_step(config: DictConfig) -> None:
    try:
        checkpoint = train(config, chosen_data(config))
    except SystemExit:  # raised by Lightning on SIGINT and SIGTERM, on the latter with 0 as if the training were done
        _print_how_to_resume(config)
        sys.exit(1)
    _print_next_step(checkpoint.resolve(), config)


@rank_zero_only
def _print_next_step(checkpoint: Path, config: DictConfig) -> None:
    if checkpoint.exists():
        print(f"\ncheckpoint: {checkpoint}")
        if any(Path(config.run_dir).rglob("events.out.tfevents*")):
            print(f"curves:     tensorboard --logdir {shlex.quote(str(config.run_dir))}")
        print(f"next:       {_command_as_here(checkpoint, 'evaluate', config)}")


@rank_zero_only
def _print_how_to_resume(config: DictConfig) -> None:
    last = Path(config.run_dir).resolve() / "checkpoints" / "last.ckpt"
    if last.exists():
        print(f"\ninterrupted: the last whole epoch is in {last}")
        print(f"go on:       {_command_as_here(last, 'train', config)}")
    else:
        print("\ninterrupted before the end of an epoch: there is no new checkpoint")


def _command_as_here(checkpoint: Path, program: str, config: DictConfig) -> str:
    """The command with the overrides of this run that its data needs."""
    hydra = HydraConfig.get()
    folder = next((place.path for place in hydra.runtime.config_sources if place.provider == "command-line"), None)
    is_data_stored = config.data["_target_"].startswith(TRUSTED_PACKAGES)
    return command_with(checkpoint, program, hydra.overrides.task, folder, is_data_stored)


def _require_workable(config: DictConfig) -> None:
    """Raise a `UserError` if settings contradict each other, before hours are spent on data."""
    trainer = config.trainer
    if config.scheduler not in config.schedulers:
        raise UserError(f"scheduler={config.scheduler}: choose one of {', '.join(config.schedulers)}")
    if str(trainer.precision) not in _PRECISIONS:
        raise UserError(
            f"trainer.precision={trainer.precision}: scans need more than 16 bits, and poses no more than 32\n"
            f"  change: trainer.precision to one of {', '.join(_PRECISIONS)}"
        )
    if trainer.gradient_clip_val and "16" in str(trainer.precision) and config.optimizer.get("fused"):
        raise UserError(
            f"trainer.gradient_clip_val={trainer.gradient_clip_val} with trainer.precision={trainer.precision}: "
            "fused optimizers cannot clip gradients in 16-bit precision\n  change: optimizer.fused=false"
        )
    by_steps = config.schedulers[config.scheduler].get("total_steps", 0) is None
    # To Lightning, max_epochs=null means 1000 epochs, or endless if max_time is set.
    is_endless = trainer.max_epochs == -1 or (trainer.max_epochs is None and trainer.max_time is not None)
    if by_steps and is_endless and trainer.max_steps == -1:
        raise UserError(
            f"scheduler={config.scheduler} depends on the length of the training, which has no end: "
            f"trainer.max_epochs={trainer.max_epochs or 'null'}\n"
            "  change: trainer.max_epochs, or scheduler=step or constant"
        )
    if str(trainer.val_check_interval) not in ("None", "1.0"):
        raise UserError(
            f"trainer.val_check_interval={trainer.val_check_interval}: the best checkpoint is chosen among whole epochs"
            "\n  change: trainer.check_val_every_n_epoch, or trainer.limit_train_batches for shorter epochs"
        )
    savers = [f"~callbacks.{name}" for name in ("last_checkpoint", "best_checkpoint") if name in config.callbacks]
    if trainer.enable_checkpointing is False and savers:
        raise UserError(
            f"trainer.enable_checkpointing=false: callbacks cannot save checkpoints\n  change: add {' '.join(savers)}"
        )
    if not trainer.logger and "learning_rate" in config.callbacks:
        raise UserError(
            "trainer.logger=false: there is no logger for the learning rate\n  change: add ~callbacks.learning_rate"
        )


def _require_free(run_folder: Path, resumed: str | None) -> None:
    """Raise a `UserError` if a run folder holds another training: curves and checkpoints would mix."""
    folder = run_folder / "checkpoints"
    if checkpoints_in(run_folder) and (resumed is None or Path(resumed).resolve().parent != folder.resolve()):
        raise UserError(
            f"{run_folder} holds the checkpoints of another training\n"
            f"  change: hydra.run.dir to another folder (hydra.sweep.dir or subdir with -m), or delete this one, "
            f"or ckpt={folder / 'last.ckpt'} to resume it"
        )


def build_module(config: DictConfig, datamodule: OdometryDataModule, data_name: str) -> PoseNetModule:
    """The module to train, built from plain dicts, so that its checkpoint needs no config.

    Args:
        config: composed from `configs/train.yaml`.
        datamodule: built from the same configuration.
        data_name: the chosen option of the group `data`.

    Raises:
        UserError: a part does not accept its settings.
    """

    def plain(node: str) -> dict[str, Any]:
        return cast("dict[str, Any]", OmegaConf.to_container(config[node], resolve=True))

    trained_on = {
        "data": {key: value for key, value in plain("data").items() if key != "root"},
        "data_name": data_name,
        "train_sequences": list(datamodule.data.train_sequences),  # the data set's own names: the setting may be null
        "loss": config.loss["_target_"].rpartition(".")[2],
        "git": git_revision(),
        "lidarlearn": lidarlearn.__version__,
        "settings": settings_to_keep(config),
        "projection": asdict(datamodule.projection),
    }
    parts = {node: plain(node) for node in ("model", "loss", "optimizer")}
    parts["scheduler"] = plain("schedulers")[config.scheduler]
    return build(plain("module"), PoseNetModule, **parts, trained_on=trained_on)
