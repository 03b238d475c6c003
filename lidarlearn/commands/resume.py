"""`python train.py ckpt=...`: a training resumes with its own settings, unless the command line changes them."""

from pathlib import Path
from typing import Any

from omegaconf import DictConfig, OmegaConf

from lidarlearn.commands.checkpoint_options import (
    GLOBAL,
    OPTION,
    RECIPE,
    add_to_search_path,
    given_checkpoint,
    is_data_given,
    write_data,
    write_option,
)
from lidarlearn.training.checkpoints import load_checkpoint
from lidarlearn.training.module import PoseNetModule
from lidarlearn.training.parts import PARTS, require_plain, require_trusted

# Settings that the result depends on, besides the parts and the data; devices, paths and displays may change.
_OF_DATAMODULE = ("batch_size", "augmentation")
_OF_TRAINER = (
    "max_epochs", "min_epochs", "max_steps", "min_steps", "precision", "accumulate_grad_batches", "gradient_clip_val",
    "gradient_clip_algorithm", "limit_train_batches", "limit_val_batches", "overfit_batches",
    "check_val_every_n_epoch", "sync_batchnorm",
)  # fmt: skip


def settings_to_keep(config: DictConfig) -> dict[str, Any]:
    """Settings that a checkpoint stores besides parts and data, so that a resumed training continues identically."""

    def plain(node: DictConfig, keys: tuple[str, ...]) -> dict[str, Any]:
        values = {key: node[key] for key in keys}
        return {k: OmegaConf.to_container(v, resolve=True) if OmegaConf.is_config(v) else v for k, v in values.items()}

    return {
        **plain(config, ("seed", "scheduler")),
        "datamodule": plain(config.datamodule, _OF_DATAMODULE),
        "trainer": plain(config.trainer, _OF_TRAINER),
    }


def add_settings(arguments: list[str], folder: Path) -> None:
    """Let `ckpt=...` choose the data, the parts and the recipe of its training.

    Args:
        arguments: the command line, completed in place.
        folder: an empty folder for the options.
    """
    path = given_checkpoint(arguments, "one at a time")
    if path is None or RECIPE in arguments:  # further processes of a training inherit the completed command line
        return
    chosen = ["model", "loss", "optimizer"]
    if not is_data_given(arguments):
        write_data(path, folder)
        chosen.append("data")
    checkpoint = load_checkpoint(path)
    parts = checkpoint["hyper_parameters"]
    trained_on = parts["trained_on"]
    settings = trained_on.get("settings", {})
    for part, kind in PARTS.items():
        require_trusted(parts[part], kind)
    require_trusted({"_target_": checkpoint["module"]}, PoseNetModule)
    of_module = {key: value for key, value in parts.items() if key not in (*PARTS, "trained_on")}
    require_plain({**settings, **of_module})
    name = settings.get("scheduler", OPTION)
    of_projection = {key: trained_on["projection"][key] for key in ("height", "width")}
    recipe = {
        "defaults": [*({f"override /{part}": OPTION} for part in chosen), "_self_"],
        "module": {"_target_": checkpoint["module"], **of_module},
        "datamodule": {**of_projection, **_only(_OF_DATAMODULE, settings.get("datamodule", {}))},
        "trainer": _only(_OF_TRAINER, settings.get("trainer", {})),
        "scheduler": name,
        "schedulers": {name: parts["scheduler"]},
        **_only(("seed",), settings),
    }
    for part in ("model", "loss", "optimizer"):
        write_option(folder, part, parts[part])
    write_option(folder, "recipe", recipe, header=GLOBAL)
    add_to_search_path(arguments, folder, RECIPE, "~recipe/for_data")


def _only(keys: tuple[str, ...], settings: dict[str, Any]) -> dict[str, Any]:
    return {key: settings[key] for key in keys if key in settings}
