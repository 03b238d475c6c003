"""Whether a configuration fits what it configures."""

import inspect

from hydra.utils import get_object


def check_binds(node: dict) -> None:
    """Every `_target_` below takes the keys beside it; the package's own classes name all that they have defaults for.

    What has no default may be made at run time.
    """
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
            check_binds(value)
