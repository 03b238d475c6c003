"""Building the parts of a training (model, loss, optimizer, scheduler) from the plain dicts of a checkpoint."""

import importlib
import inspect
from collections.abc import Mapping
from typing import Any

from torch import nn
from torch.optim import Optimizer
from torch.optim.lr_scheduler import LRScheduler

from lidarlearn.data.augmentation import Augmentation
from lidarlearn.errors import UserError
from lidarlearn.geometry.projection import SphericalProjection
from lidarlearn.simulation.sensors import Sensor

TRUSTED_PACKAGES = ("lidarlearn.", "torch.optim.")

# The parts of a training, by the keys of the dicts that describe them in a checkpoint.
PARTS = {"model": nn.Module, "loss": nn.Module, "optimizer": Optimizer, "scheduler": LRScheduler}

# What may be built within a part, by key: only classes whose constructors are known to have no side effects.
_NESTED_PARTS = {"projection": SphericalProjection, "sensor": Sensor, "augmentation": Augmentation}


class UntrustedTargetError(UserError):
    """A dict describes something other than a part of this project or of torch with plain values."""

    def __init__(self, what: str, why: str) -> None:
        super().__init__(
            f"{what} is refused: {why}; otherwise a checkpoint could run arbitrary code\n"
            "  change: use a checkpoint written by lidarlearn's training; a class of your own has to be in lidarlearn/,"
            " except a data set, which data=NAME can select instead"
        )


def build(node: Mapping[str, Any], kind: type, **arguments: Any) -> Any:
    """An instance of the class that `_target_` names, with the dict's other keys as arguments.

    The dict may come from an untrusted checkpoint, see `require_trusted`.

    Args:
        node: `_target_` and the constructor's arguments, plain values.
        kind: the class that the instance must have.
        arguments: further arguments that only exist at run time, such as an optimizer's parameters.

    Raises:
        UntrustedTargetError: `_target_` is missing or names anything else.
        UserError: the constructor does not accept the arguments.
    """
    name = node.get("_target_")
    target = _trusted(name, kind)
    merged = {**{str(key): value for key, value in node.items() if key != "_target_"}, **arguments}
    try:
        inspect.signature(target).bind(**merged)
    except TypeError as error:
        keys = ", ".join(inspect.signature(target).parameters)
        raise UserError(f"{name}: {error}\n  change: its keys are {keys}") from error
    try:
        return target(**merged)
    except (TypeError, ValueError) as error:  # the constructor rejects a value
        given = {key: value for key, value in merged.items() if key not in arguments}
        raise UserError(f"{name}: {error}\n  it was given {given}") from error


def argument(node: Mapping[str, Any], key: str) -> Any:
    """The value of a constructor's argument: as in the dict or, if an older dict lacks it, its default.

    Args:
        node: see `build`.
        key: name of the argument.

    Returns:
        None if the constructor has no such argument, or no default for it.
    """
    if key in node:
        return node[key]
    parameter = inspect.signature(_trusted(node.get("_target_"), object)).parameters.get(key)
    return None if parameter is None or parameter.default is parameter.empty else parameter.default


def require_trusted(node: Mapping[str, Any], kind: type) -> None:
    """Check that a config from a checkpoint describes an instance of a class and can do nothing else.

    Hydra can then build from it only classes of `TRUSTED_PACKAGES`, each of the kind that belongs in its place and
    with plain values as arguments: no other callable, none of Hydra's own keys, no interpolation.

    Args:
        node: `_target_` and the constructor's arguments.
        kind: the class that it must describe.

    Raises:
        UntrustedTargetError: it is anything else.
    """
    _trusted(node.get("_target_"), kind)
    require_plain({key: value for key, value in node.items() if key != "_target_"})


def require_plain(value: object, key: str = "") -> None:
    """Check that a value from a checkpoint is plain data, or a part of the kind that belongs under its key.

    Raises:
        UntrustedTargetError: it is anything else.
    """
    if isinstance(value, Mapping) and "_target_" in value:
        if key not in _NESTED_PARTS:
            raise UntrustedTargetError(f"{key}._target_", "nothing can be built in this place")
        require_trusted(value, _NESTED_PARTS[key])
    elif isinstance(value, Mapping):
        for name, inner in value.items():
            if not isinstance(name, str | int) or str(name).startswith("_") or name == "defaults":
                raise UntrustedTargetError(f"the key {name!r}", "Hydra would act on it")
            require_plain(inner, str(name))
    elif isinstance(value, list | tuple):
        for inner in value:
            require_plain(inner, key)
    elif not isinstance(value, str | int | float | None) or (isinstance(value, str) and "${" in value):
        raise UntrustedTargetError(f"{key}={value!r}", "it is not a plain value")


def _trusted(name: object, kind: type) -> Any:
    """The class of that name if it is of the kind and a trusted package defines it.

    A public function also counts that is defined beside the kind and returns it, such as `sensors.hdl64`.
    """
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
    else:
        is_ours = inspect.isfunction(target) and target.__module__ == kind.__module__ == module_name
        trusted = is_ours and inspect.signature(target).return_annotation is kind
    if not trusted:
        raise UntrustedTargetError(f"_target_ {name!r}", allowed)
    return target
