"""`ckpt=...` without `data=...`: the settings of a checkpoint as options of the config groups.

The options are called `checkpoint`, e.g. `data=checkpoint`, and are written to a temporary folder on Hydra's search
path, so that every override works on them. The classes that they name are checked, see `require_trusted`.
"""

import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from hydra.core.hydra_config import HydraConfig
from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.core.override_parser.types import Quote, QuotedString
from hydra.errors import OverrideParseException
from omegaconf import DictConfig, OmegaConf

from lidarlearn.data.sequence import DataSet
from lidarlearn.errors import UserError
from lidarlearn.training.checkpoints import CheckpointError, load_checkpoint
from lidarlearn.training.parts import require_trusted

OPTION = "checkpoint"
RECIPE = f"recipe={OPTION}"  # applied after the defaults, before experiments and the command line
GLOBAL = "# @package _global_\n"
_CHECKPOINT = re.compile(r"\+{0,2}ckpt=")
_SEARCH_PATH = "hydra.searchpath"
_CLUSTER = "hydra/launcher=submitit_slurm"


def given_checkpoint(arguments: Sequence[str], instead_of_several: str) -> Path | None:
    """The checkpoint on a command line; None if there is none, or `ckpt=null`.

    Args:
        arguments: the command line.
        instead_of_several: the remedy in the error about several checkpoints.

    Raises:
        UserError: several checkpoints are given, for the jobs of a multirun.
    """
    given = next((argument for argument in reversed(arguments) if _CHECKPOINT.match(argument)), "ckpt=null")
    try:
        path = OverridesParser.create().parse_override(given).value()
    except OverrideParseException:
        return None  # composing the configuration reports the error
    if path is not None and not isinstance(path, str):
        raise UserError(f"{given}: each checkpoint has its own settings\n  change: {instead_of_several}")
    return None if path is None else Path(path)


def add_data(arguments: list[str], folder: Path) -> None:
    """Let `ckpt=...` choose the data that it was trained on, unless `data=...` or an experiment does.

    Args:
        arguments: the command line, completed in place.
        folder: an empty folder for the options.

    Raises:
        UserError: the checkpoint cannot be read or names no data, and no `experiment=` could choose the data instead.
    """
    if is_data_given(arguments) or RECIPE in arguments:
        return
    try:
        path = given_checkpoint(arguments, "one at a time; to evaluate several, add data=...")
        if path is not None:
            write_data(path, folder)
            write_option(folder, "recipe", {"defaults": [{"override /data": OPTION}]}, header=GLOBAL)
            add_to_search_path(arguments, folder, RECIPE)
    except UserError:
        if not any(argument.startswith("experiment=") for argument in arguments):
            raise


def is_data_given(arguments: Sequence[str]) -> bool:
    """Whether a command line chooses its data."""
    return any(argument.startswith("data=") for argument in arguments)


def write_data(path: Path, folder: Path) -> None:
    """Write the data settings of a checkpoint as an option, without `data.root`, which depends on the machine.

    Raises:
        CheckpointError: the checkpoint names no data set.
        UntrustedTargetError: the class of the data set is not from a trusted package.
    """
    trained_on = load_checkpoint(path)["hyper_parameters"]["trained_on"]
    name, data = str(trained_on["data_name"]), trained_on["data"]
    require_trusted(data, DataSet)
    if not re.fullmatch(r"\w[\w-]*", name):
        raise CheckpointError(path, f"was trained on data={name}, which is not a valid name of a data set.")
    settings = {key: value for key, value in data.items() if key != "root"}
    write_option(folder, "data", {"defaults": [f"{name}@_here_", "_self_"], **settings})


def add_to_search_path(arguments: list[str], folder: Path, *options: str) -> None:
    """Add a folder of options to Hydra's search path, keeping the folders that the command line adds.

    Args:
        arguments: the command line, completed in place: after the overrides, before flags that may follow.
        folder: the folder, which only this machine can read; for the message.
        options: further overrides to add.

    Raises:
        UserError: the jobs run on other machines.
    """
    if _CLUSTER in arguments:
        raise UserError(
            f"{_CLUSTER}: its nodes do not see the settings of the checkpoint, which are in {folder}\n"
            "  change: submit a job that runs this command without the launcher, "
            "or, for an evaluation, add data=... and its settings"
        )
    given = [argument for argument in arguments if argument.startswith(f"{_SEARCH_PATH}=")]
    places = [f"file://{folder.as_posix()}"]
    if given:
        places_given = OverridesParser.create().parse_override(given[0]).value()  # Hydra takes the first one
        if not isinstance(places_given, list):
            return  # composing the configuration reports the error
        places += places_given
    arguments[:] = [argument for argument in arguments if argument not in given]
    end = max(i for i, argument in enumerate(arguments) if _CHECKPOINT.match(argument))
    while end < len(arguments) and not arguments[end].startswith("-"):
        end += 1
    search_path = f"{_SEARCH_PATH}=[{','.join(quoted(str(place)) for place in dict.fromkeys(places))}]"
    arguments[end:end] = [*options, search_path]


def quoted(text: str) -> str:
    """A text quoted for Hydra's grammar, where spaces and commas have a meaning."""
    return QuotedString(text, Quote.double).with_quotes()


def write_option(folder: Path, group: str, content: Mapping[str, Any], header: str = "") -> None:
    """Write the option `checkpoint` of a group."""
    path = folder / group / f"{OPTION}.yaml"
    path.parent.mkdir(parents=True)
    path.write_text(header + OmegaConf.to_yaml(OmegaConf.create(dict(content))), encoding="utf-8")


def chosen_data(config: DictConfig) -> str:
    """The name of the data set of this run; for `data=checkpoint` the name that the checkpoint stores."""
    choice = HydraConfig.get().runtime.choices["data"]
    if choice != OPTION:
        return choice
    return load_checkpoint(Path(config.ckpt))["hyper_parameters"]["trained_on"]["data_name"]
