"""Parts of a training (model, loss, optimizer, scheduler) built from plain dicts, which a checkpoint can hold."""

import importlib
import inspect
from collections.abc import Mapping
from typing import Any

from lidarlearn.errors import UserError

TRUSTED_PACKAGES = ("lidarlearn.", "torch.optim.", "torchvision.models.")


class UntrustedTargetError(UserError):
    """A dict names something to build that is none of this project's, or of torch's, parts."""


def build(node: Mapping[str, Any], **arguments: Any) -> Any:
    """An instance of the class that `_target_` names, with the dict's other keys as arguments.

    The dict may come out of a checkpoint from anywhere, so it can name classes of `TRUSTED_PACKAGES` only, by the
    module that defines them: nothing that these modules merely import, and no interpolations.

    Args:
        node: `_target_` and the constructor's arguments, plain values.
        arguments: further arguments that only exist at run time, such as an optimizer's parameters.

    Raises:
        UntrustedTargetError: `_target_` is missing or names something else.
        UserError: the constructor does not take, or refuses, the arguments.
    """
    name = node.get("_target_")
    target = _trusted_class(name)
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


def require_trusted(node: object) -> None:
    """Check, at any depth, that a config out of a checkpoint names nothing but classes and functions of these packages.

    Raises:
        UntrustedTargetError: a `_target_` names something else.
    """
    if isinstance(node, Mapping):
        if "_target_" in node:
            _trusted(node["_target_"])
        for value in node.values():
            require_trusted(value)
    elif isinstance(node, list | tuple):
        for value in node:
            require_trusted(value)


def _trusted_class(name: object) -> type:
    target = _trusted(name)
    if not inspect.isclass(target):
        raise UntrustedTargetError(f"_target_ {name!r} is not built: it is no class of {', '.join(TRUSTED_PACKAGES)}*")
    return target


def _trusted(name: object) -> Any:
    """The class or function of that name, if one of the trusted packages defines it and not merely imports it."""
    if not isinstance(name, str) or not name.startswith(TRUSTED_PACKAGES):
        raise UntrustedTargetError(f"_target_ {name!r} is not built: only {', '.join(TRUSTED_PACKAGES)}* are")
    module_name, _, attribute = name.rpartition(".")
    try:
        target = getattr(importlib.import_module(module_name), attribute)
    except (ImportError, AttributeError) as error:
        raise UserError(f"_target_ {name!r} does not exist: {error}") from error
    if not callable(target) or not f"{getattr(target, '__module__', '')}.".startswith(TRUSTED_PACKAGES):
        raise UntrustedTargetError(f"_target_ {name!r} is not built: {', '.join(TRUSTED_PACKAGES)}* do not define it")
    return target


def _keys(target: type) -> str:
    return ", ".join(name for name in inspect.signature(target).parameters if name != "self")
