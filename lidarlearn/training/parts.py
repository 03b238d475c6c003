"""Parts of a training (model, loss, optimizer, scheduler) built from plain dicts, which a checkpoint can hold."""

import importlib
import inspect
from collections.abc import Mapping
from typing import Any

from lidarlearn.data.augmentation import Augmentation
from lidarlearn.errors import UserError
from lidarlearn.geometry.projection import SphericalProjection
from lidarlearn.simulation.sensors import Sensor

TRUSTED_PACKAGES = ("lidarlearn.", "torch.optim.")

# What may stand within a part, by its key: of each kind alone is it known that making one does nothing else.
_PARTS_WITHIN = {"projection": SphericalProjection, "sensor": Sensor, "augmentation": Augmentation}


class UntrustedTargetError(UserError):
    """A dict asks for more than one of this project's, or of torch's, parts with plain values."""

    def __init__(self, what: str, why: str) -> None:
        super().__init__(
            f"{what} is refused: {why}; a checkpoint could run any code otherwise\n"
            "  change: use a checkpoint written by lidarlearn's training; a class of your own belongs into lidarlearn/,"
            " but one that reads data may also be chosen by data=NAME"
        )


def build(node: Mapping[str, Any], kind: type, **arguments: Any) -> Any:
    """An instance of the class that `_target_` names, with the dict's other keys as arguments.

    The dict may come out of a checkpoint from anywhere: see `require_trusted`.

    Args:
        node: `_target_` and the constructor's arguments, plain values.
        kind: what it is to be.
        arguments: further arguments that only exist at run time, such as an optimizer's parameters.

    Raises:
        UntrustedTargetError: `_target_` is missing or names something else.
        UserError: the constructor does not take, or refuses, the arguments.
    """
    name = node.get("_target_")
    target = _trusted(name, kind)
    merged = {**{str(key): value for key, value in node.items() if key != "_target_"}, **arguments}
    try:
        inspect.signature(target).bind(**merged)
    except TypeError as error:
        raise UserError(f"{name}: {error}\n  change: its keys are {_keys(target)}") from error
    try:
        return target(**merged)
    except (TypeError, ValueError) as error:  # a value that the constructor refuses
        given = {key: value for key, value in merged.items() if key not in arguments}
        raise UserError(f"{name}: {error}\n  it was given {given}") from error


def argument(node: Mapping[str, Any], key: str) -> Any:
    """The value of a part's setting: the constructor's default where the dict, such as an older one, does not have it.

    Args:
        node: see `build`.
        key: of the setting.

    Returns:
        None where the constructor takes no such argument, or has no default for it.
    """
    if key in node:
        return node[key]
    parameter = inspect.signature(_trusted(node.get("_target_"), object)).parameters.get(key)
    return None if parameter is None or parameter.default is parameter.empty else parameter.default


def require_trusted(node: Mapping[str, Any], kind: type) -> None:
    """Check that a config out of a checkpoint describes a thing of that kind, and can do nothing but describe it.

    Whatever Hydra builds from it then is a class of `TRUSTED_PACKAGES` and of the kind that belongs in its place, given
    plain values: no other callable, no arguments under Hydra's own keys, no interpolation.

    Args:
        node: `_target_` and the constructor's arguments.
        kind: what it is to be.

    Raises:
        UntrustedTargetError: it is something else.
    """
    _trusted(node.get("_target_"), kind)
    require_plain({key: value for key, value in node.items() if key != "_target_"})


def require_plain(value: object, key: str = "") -> None:
    """Check that a value out of a checkpoint is plain data, or a part of the kind that belongs under its key.

    Raises:
        UntrustedTargetError: it is not.
    """
    if isinstance(value, Mapping):
        if "_target_" in value:
            if key not in _PARTS_WITHIN:
                raise UntrustedTargetError(f"{key}._target_", "there is nothing to build in this place")
            return require_trusted(value, _PARTS_WITHIN[key])
        for name, inner in value.items():
            if not isinstance(name, str | int) or str(name).startswith("_") or name == "defaults":
                raise UntrustedTargetError(f"the key {name!r}", "it would tell Hydra what to do")
            require_plain(inner, str(name))
    elif isinstance(value, list | tuple):
        for inner in value:
            require_plain(inner, key)
    elif not isinstance(value, str | int | float | None) or (isinstance(value, str) and "${" in value):
        raise UntrustedTargetError(f"{key}={value!r}", "it is no plain value")
    return None


def _trusted(name: object, kind: type) -> Any:
    """The class of that name, if it is of the kind and a trusted package defines it; or a function beside the kind."""
    allowed = f"it can only be a public {kind.__name__} that {' or '.join(p + '*' for p in TRUSTED_PACKAGES)} defines"
    if not isinstance(name, str) or not name.startswith(TRUSTED_PACKAGES) or "._" in name:
        raise UntrustedTargetError(f"_target_ {name!r}", allowed)
    module_name, _, attribute = name.rpartition(".")
    try:
        target = getattr(importlib.import_module(module_name), attribute)
    except (ImportError, AttributeError) as error:
        raise UserError(f"_target_ {name!r} does not exist: {error}") from error
    if inspect.isclass(target):
        trusted = issubclass(target, kind) and f"{target.__module__}.".startswith(TRUSTED_PACKAGES)
    else:  # such as a sensor's function, that returns one
        is_ours = inspect.isfunction(target) and target.__module__ == kind.__module__ == module_name
        trusted = is_ours and inspect.signature(target).return_annotation is kind
    if not trusted:
        raise UntrustedTargetError(f"_target_ {name!r}", allowed)
    return target


def _keys(target: type) -> str:
    return ", ".join(name for name in inspect.signature(target).parameters if name != "self")
