"""`python train.py`: train PoseNet on a data set, with or without ground truth."""

import os
import shlex
import string
from pathlib import Path
from typing import Any

from hydra.core.hydra_config import HydraConfig
from hydra.utils import instantiate
from lightning.pytorch import Trainer, seed_everything
from omegaconf import DictConfig, OmegaConf

import lidarlearn
from lidarlearn.commands import entry_point
from lidarlearn.commands.run_folder import git_revision, write_run_description
from lidarlearn.data.datamodule import OdometryDataModule
from lidarlearn.errors import UserError
from lidarlearn.training.checkpoints import load_checkpoint
from lidarlearn.training.module import PoseNetModule
from lidarlearn.training.parts import build
from lidarlearn.training.quiet import quiet

_PLAIN_CHARACTERS = frozenset(string.ascii_letters + string.digits + "/._-:+")


def main() -> None:
    """Entry point of `train.py` and `lidarlearn-train`."""
    entry_point.run(lambda config: _train_and_say_what_next(config), "train")


def train(config: DictConfig, data_name: str) -> Path:
    """Train as configured, from the start or from where `ckpt` ended.

    Args:
        config: composed from `configs/train.yaml`.
        data_name: the config's choice of data, for the checkpoint to tell.

    Returns:
        The best checkpoint by validation, or the last one where nothing was validated.

    Raises:
        UserError: the data, the checkpoint or a setting is not as it should be.
    """
    quiet()
    seed_everything(config.seed, workers=True, verbose=False)
    run_folder = Path(config.run_dir)
    datamodule: OdometryDataModule = instantiate(config.datamodule)
    module = build_module(config, datamodule, data_name)
    if config.ckpt is not None:
        _check_resumable(Path(config.ckpt), module, config.trainer.max_epochs)
    trainer: Trainer = instantiate(config.trainer)
    if trainer.is_global_zero:
        write_run_description(run_folder, config)
    trainer.fit(module, datamodule=datamodule, ckpt_path=config.ckpt)
    best = run_folder / "checkpoints" / "best.ckpt"
    return best if best.exists() else best.with_name("last.ckpt")


def evaluate_command(checkpoint: Path) -> str:
    """The command that evaluates a checkpoint, as it can be pasted into a shell."""
    path = str(checkpoint.relative_to(Path.cwd()) if checkpoint.is_relative_to(Path.cwd()) else checkpoint)
    if not _PLAIN_CHARACTERS.issuperset(path):
        path = '"' + path.replace('"', r"\"") + '"'  # for Hydra's grammar; the shell's quotes come around it
    program = "python evaluate.py" if Path("evaluate.py").is_file() else "lidarlearn-evaluate"
    return f"{program} {shlex.quote(f'ckpt={path}')}"


def _train_and_say_what_next(config: DictConfig) -> None:
    checkpoint = train(config, HydraConfig.get().runtime.choices["data"]).resolve()
    first_process = os.environ.get("LOCAL_RANK", "0") == "0" and os.environ.get("NODE_RANK", "0") == "0"
    if first_process and checkpoint.exists():
        print(f"\ncheckpoint: {checkpoint}\ncurves:     tensorboard --logdir {shlex.quote(str(config.run_dir))}")
        print(f"next:       {evaluate_command(checkpoint)}")


def build_module(config: DictConfig, datamodule: OdometryDataModule, data_name: str) -> PoseNetModule:
    """The module to train, from plain dicts, so that its checkpoint needs no config.

    Args:
        config: composed from `configs/train.yaml`.
        datamodule: of the same configuration.
        data_name: choice of the group `data`.

    Raises:
        UserError: a part does not take its settings.
    """

    def plain(node: str) -> dict[str, Any]:
        return OmegaConf.to_container(config[node], resolve=True)  # type: ignore[return-value]

    p = datamodule.projection
    trained_on = {
        "data": plain("data"),
        "data_name": data_name,
        "loss": config.loss["_target_"].rpartition(".")[2],
        "git": git_revision(),
        "lidarlearn": lidarlearn.__version__,
        "projection": {
            "height": p.height,
            "width": p.width,
            "fov_up_deg": p.fov_up_deg,
            "fov_down_deg": p.fov_down_deg,
        },
    }
    parts = {node: plain(node) for node in ("model", "loss", "optimizer")}
    if config.scheduler not in config.schedulers:
        raise UserError(f"scheduler={config.scheduler}: choose one of {', '.join(config.schedulers)}")
    parts["scheduler"] = plain("schedulers")[config.scheduler]
    return build(plain("module"), **parts, trained_on=trained_on)


def _check_resumable(path: Path, module: PoseNetModule, max_epochs: int | None) -> None:
    """Raise a `UserError` where a checkpoint cannot be continued with this configuration."""
    checkpoint = load_checkpoint(path)
    for part in ("model", "loss"):
        was, now = checkpoint["hyper_parameters"][part], module.hparams[part]
        if was != now:
            raise UserError(
                f"ckpt={path} was trained with {part} {was}\n  this run has {now}\n  change: one of the two"
            )
    done = checkpoint["epoch"] + 1
    if max_epochs is not None and 0 <= max_epochs <= done:
        raise UserError(f"ckpt={path} has already seen {done} epochs\n  change: trainer.max_epochs to more than that")
