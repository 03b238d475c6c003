"""`ckpt=...` without `data=...`: what a checkpoint was made with, as options of the config groups.

They are called `checkpoint`, e.g. `data=checkpoint`, and lie in a temporary folder on Hydra's search path, so that
every override works on them as on the others. What they ask to build is checked: see `require_trusted`.
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
RECIPE = f"recipe={OPTION}"  # comes after the defaults, and before experiments and the command line
GLOBAL = "# @package _global_\n"
_CHECKPOINT = re.compile(r"\+{0,2}ckpt=")
_SEARCH_PATH = "hydra.searchpath"
_CLUSTER = "hydra/launcher=submitit_slurm"


def given_checkpoint(arguments: Sequence[str], instead_of_several: str) -> Path | None:
    """The checkpoint on a command line, None where there is none, or `null`.

    Args:
        arguments: the command line.
        instead_of_several: what to do rather than to give several checkpoints.

    Raises:
        UserError: there are several, for the jobs of a multirun.
    """
    given = next((argument for argument in reversed(arguments) if _CHECKPOINT.match(argument)), "ckpt=null")
    try:
        path = OverridesParser.create().parse_override(given).value()
    except OverrideParseException:
        return None  # composing the configuration will say what is wrong
    if path is not None and not isinstance(path, str):
        raise UserError(f"{given}: each checkpoint comes with settings of its own\n  change: {instead_of_several}")
    return None if path is None else Path(path)


def add_data(arguments: list[str], folder: Path) -> None:
    """Let `ckpt=...` choose the data it was trained on, unless `data=...` or an experiment does.

    Args:
        arguments: the command line; it is completed.
        folder: an empty one for the options.

    Raises:
        UserError: that cannot be, and no experiment is asked for that might choose the data.
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
    """Make the data of a checkpoint an option. Where they lie is that of this machine: `data.root`.

    Raises:
        CheckpointError: it names no data set.
        UntrustedTargetError: they are of a foreign class.
    """
    trained_on = load_checkpoint(path)["hyper_parameters"]["trained_on"]
    name, data = str(trained_on["data_name"]), trained_on["data"]
    require_trusted(data, DataSet)
    if not re.fullmatch(r"\w[\w-]*", name):
        raise CheckpointError(path, f"was trained on data={name}, which is no name of a data set.")
    settings = {key: value for key, value in data.items() if key != "root"}
    write_option(folder, "data", {"defaults": [f"{name}@_here_", "_self_"], **settings})


def add_to_search_path(arguments: list[str], folder: Path, *options: str) -> None:
    """Let Hydra find the options in a folder, beside those where the command line has it search already.

    Args:
        arguments: the command line; it is completed behind the last of the overrides, where flags may follow.
        folder: of this machine alone.
        options: what else to add.

    Raises:
        UserError: the jobs run on machines that do not see the folder.
    """
    if _CLUSTER in arguments:
        raise UserError(
            f"{_CLUSTER}: its nodes do not see the settings of the checkpoint, which lie in {folder}\n"
            "  change: submit a job of your own that runs this command without the launcher, "
            "or, for an evaluation, add data=... and its settings"
        )
    given = [argument for argument in arguments if argument.startswith(f"{_SEARCH_PATH}=")]
    places = [f"file://{folder.as_posix()}"]
    if given:
        places_given = OverridesParser.create().parse_override(given[0]).value()  # Hydra takes the first one
        if not isinstance(places_given, list):
            return  # composing the configuration will say what is wrong
        places += places_given
    arguments[:] = [argument for argument in arguments if argument not in given]
    end = max(i for i, argument in enumerate(arguments) if _CHECKPOINT.match(argument))
    while end < len(arguments) and not arguments[end].startswith("-"):
        end += 1
    search_path = f"{_SEARCH_PATH}=[{','.join(quoted(str(place)) for place in dict.fromkeys(places))}]"
    arguments[end:end] = [*options, search_path]


def quoted(text: str) -> str:
    """A text in Hydra's grammar, in which spaces, commas and the like have meanings of their own."""
    return QuotedString(text, Quote.double).with_quotes()


def write_option(folder: Path, group: str, content: Mapping[str, Any], header: str = "") -> None:
    """Make `checkpoint` an option of a group."""
    path = folder / group / f"{OPTION}.yaml"
    path.parent.mkdir(parents=True)
    path.write_text(header + OmegaConf.to_yaml(OmegaConf.create(dict(content))), encoding="utf-8")


def chosen_data(config: DictConfig) -> str:
    """The name of the data of this run, as a checkpoint that was asked for its own has it."""
    choice = HydraConfig.get().runtime.choices["data"]
    if choice != OPTION:
        return choice
    return load_checkpoint(Path(config.ckpt))["hyper_parameters"]["trained_on"]["data_name"]
