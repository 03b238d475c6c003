"""Composed configurations, and a check that they fit what they configure."""

import inspect
from functools import cache

from hydra import compose, initialize_config_dir
from hydra.utils import get_object
from omegaconf import DictConfig, OmegaConf

from lidarlearn.commands.configs import config_directory

CONFIGS = config_directory()


@cache
def composed_with_hydra(program: str, *overrides: str) -> DictConfig:
    """The config of a command line, with Hydra's own node; composed once per process and therefore read-only."""
    with initialize_config_dir(str(CONFIGS), version_base="1.3"):
        config = compose(program, ["++run_dir=run", *overrides], return_hydra_config=True)
    OmegaConf.set_readonly(config, True)
    return config


def composed(program: str, *overrides: str) -> DictConfig:
    """The config of a command line."""
    config = composed_with_hydra(program, *overrides)
    return OmegaConf.masked_copy(config, [str(key) for key in config if key != "hydra"])


def options(group: str) -> list[str]:
    """The names of all options of a group."""
    folder = CONFIGS / group
    paths = (path.relative_to(folder).with_suffix("") for path in sorted(folder.rglob("*.yaml")))
    return [path.as_posix() for path in paths if path.parts[0] != "base"]


def option_nodes(program: str, *groups: str) -> dict[tuple[str, str], DictConfig]:
    """Every option of the groups by (group, option); one config holds them all, since composing takes time."""
    names = [(group, option) for group in groups for option in options(group)]
    overrides = (f"+{group}@options.{i}={option}" for i, (group, option) in enumerate(names))
    nodes = composed(program, *overrides).options
    return {name: nodes[str(i)] for i, name in enumerate(names)}


def check_binds(config: DictConfig) -> None:
    """Every `_target_` accepts the keys beside it; those of this package get every argument that has a default.

    Arguments without a default may be added at run time.
    """
    _check_node_binds(OmegaConf.to_container(config, resolve=True))


def _check_node_binds(node: dict) -> None:
    if "_target_" in node:
        target, given = node["_target_"], {key: value for key, value in node.items() if not key.startswith("_")}
        signature = inspect.signature(get_object(target))
        signature.bind_partial(**given)
        if target.startswith("lidarlearn."):
            parameters = signature.parameters.values()
            assert not any(p.kind is p.VAR_KEYWORD for p in parameters), target  # so that a typo is an error
            assert {p.name for p in parameters if p.default is not p.empty} <= given.keys(), target
    for value in node.values():
        if isinstance(value, dict):
            _check_node_binds(value)
