"""Explanations of Hydra's errors about a mistaken command line, with suggestions."""

import re
from collections.abc import Iterable, Sequence
from difflib import SequenceMatcher
from pathlib import PurePosixPath

from hydra import compose, initialize_config_dir
from hydra.core.hydra_config import HydraConfig
from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.errors import HydraException, MissingConfigException
from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException

from lidarlearn.commands.configs import config_directory
from lidarlearn.errors import UserError

_OTHER_PROGRAM = {"train": "evaluate.py", "evaluate": "train.py"}
_LEAST_LIKENESS = 0.6  # least similarity of a suggested name

_NO_OPTION = "Config group override must be"  # a ValueError, unlike Hydra's other errors


def is_mistake(error: Exception) -> bool:
    """Whether it is an error of Hydra about a command line from which no configuration can be composed."""
    return isinstance(error, HydraException | OmegaConfBaseException) or (
        isinstance(error, ValueError) and str(error).startswith(_NO_OPTION)
    )


def explanation(error: Exception, program: str, arguments: Sequence[str]) -> str:
    """What is wrong with a command line, and similar names that may have been meant.

    Args:
        error: raised while the configuration was composed; `is_mistake` is true for it.
        program: name of the primary config.
        arguments: the command line without the name of the program.
    """
    text = str(error).partition("\nConfig search path:")[0]
    if isinstance(error, MissingConfigException) and error.missing_cfg_file and error.options is not None:
        return _unknown_option(error.missing_cfg_file, error.options)
    if text.startswith(_NO_OPTION):
        return _no_option(arguments) or text
    if re.match(r"In 'experiment/.*': Could not override", text) and program in _OTHER_PROGRAM:
        return f"{text}\n  change: that experiment is for {_OTHER_PROGRAM[program]}"
    key = re.search(r"Could not (?:override|delete from config\.) '(.*?)'|config group '(.*)' does not exist", text)
    if key is not None:
        name = key[1] or key[2]
        return f"there is no setting or group '{name}'{_question(nearest(name, _keys(program, name, arguments)))}"
    # any other message, without its hints for programmers
    lines = [line.strip() for line in text.splitlines()]
    return "  ".join(line for line in lines if line and not line.startswith(("See https", "object_type=", "^")))


def require_parts(config: DictConfig) -> None:
    """Check that no part was replaced by its name: `registration.weight=huber` does not choose an option.

    Args:
        config: configuration of the running job.

    Raises:
        UserError: a string is in the place of a part.
    """
    for choice in HydraConfig.get().runtime.choices:
        group, at, place = str(choice).partition("@")
        value = OmegaConf.select(config, place) if at else None
        if isinstance(value, str):
            name = f"{place.rpartition('.')[2]}={value}"
            raise UserError(f"{place}: {name} is a name, not a part\n  change: {group}@{place}={value}")


def nearest(name: str, known: Iterable[str], at_most: int = 6) -> list[str]:
    """The names most similar to another, as a whole or in their last components."""
    likeness = {other: _likeness(name, other) for other in known if other != name}
    best = max(likeness.values(), default=0.0)
    return [other for other, value in likeness.items() if value == best >= _LEAST_LIKENESS][:at_most]


def _likeness(name: str, other: str) -> float:
    mine, theirs = re.split("[./]", name), re.split("[./]", other)
    tails = (theirs, theirs[-len(mine) :])
    spelling = max(SequenceMatcher(None, ".".join(mine), ".".join(tail)).ratio() for tail in tails)
    return max(spelling, 0.7 if mine[-1] == theirs[-1] else 0.0)


def _unknown_option(path: str, options: Sequence[str]) -> str:
    """Message about an unknown option: the most similar one of the group, and the options in the same folder."""
    group, _, option = path.partition("/")
    folder = config_directory() / group
    ours = (path.relative_to(folder).with_suffix("").as_posix() for path in folder.rglob("*.yaml"))
    known = sorted({*ours, *options})  # Hydra's options include those of the user
    beside = [other for other in known if PurePosixPath(other).parent == PurePosixPath(option).parent]
    similar = [f"{group}={other}" for other in nearest(option, known)]
    return "\n    ".join([f"there is no {group}={option}{_question(similar)}\n  options:", *(beside or options)])


def _no_option(arguments: Sequence[str]) -> str | None:
    """Message about a group whose value cannot be the name of an option, such as null; None if there is none."""
    for argument in arguments:
        if "=" in argument and not argument.startswith("-"):
            override = OverridesParser.create().parse_override(argument)
            is_name = override.is_sweep_override() or isinstance(override.value(), str | list | dict)
            if not is_name and (config_directory() / override.key_or_group).is_dir():
                unknown = _unknown_option(f"{override.key_or_group}/{override.get_value_string()}", ())
                return f"{unknown}\n  change: choose one of these, or leave {argument} out"
    return None


def _question(names: Sequence[str]) -> str:
    if len(names) == 1:
        return f"; did you mean {names[0]}?"
    return "".join(["; did you mean one of these?", *(f"\n    {name}" for name in names)]) if names else ""


def _keys(program: str, mistaken: str, arguments: Sequence[str]) -> list[str]:
    """Every key and group of a program's configuration, composed with the rest of the command line if possible."""
    rest = [a for a in arguments if "=" in a and not a.lstrip("+~").startswith((mistaken, "-"))]
    with initialize_config_dir(str(config_directory()), version_base="1.3"):
        try:
            config = compose(program, rest, return_hydra_config=True)
        except (HydraException, OmegaConfBaseException):
            config = compose(program, return_hydra_config=True)
    groups = [str(group) for group in config.hydra.runtime.choices if not str(group).startswith("hydra/")]
    return list(dict.fromkeys([*_keys_below(config), *groups]))


def _keys_below(node: DictConfig, above: str = "") -> list[str]:
    keys = []
    for name in map(str, node):
        keys.append(f"{above}{name}")
        inner = None if OmegaConf.is_missing(node, name) or OmegaConf.is_interpolation(node, name) else node[name]
        if isinstance(inner, DictConfig) and keys[-1] != "hydra":
            keys += _keys_below(inner, f"{keys[-1]}.")
    return keys
