"""Run a Hydra application that prints errors that the user can fix as one message instead of a stack trace."""

import os
import sys
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from typing import NoReturn

import hydra
from hydra.core.hydra_config import HydraConfig
from hydra.errors import InstantiationException, OverrideParseException
from hydra.types import RunMode
from omegaconf import DictConfig

from lidarlearn.commands.configs import config_directory
from lidarlearn.commands.mistakes import explanation, is_mistake, require_parts
from lidarlearn.errors import UserError

_FULL_ERROR = "HYDRA_FULL_ERROR"

# Causes of a failed instantiation that a setting can fix, besides a UserError; any other is a bug.
_SETTINGS_AT_FAULT = (TypeError, ValueError, ImportError)


def run(task: Callable[[DictConfig], None], config_name: str, prepare: Callable[[], None] = lambda: None) -> None:
    """Compose the configuration from the command line and run the task with it, once or for every job of a multirun.

    An error that the user can fix is printed as one message, and the process exits with 1: a `UserError`, a typo in a
    group or a key, settings that contradict each other. Any other error keeps its stack trace. With the environment
    variable HYDRA_FULL_ERROR=1 every error does.

    Args:
        task: called with the composed configuration.
        config_name: name of the primary config in `configs/`.
        prepare: called before the configuration is composed, e.g. to complete the command line.
    """
    if os.environ.get(_FULL_ERROR) == "1":
        prepare()
        _application(task, config_name)()
        return

    def task_with_readable_errors(config: DictConfig) -> None:
        try:
            require_parts(config)
            task(config)
        except Exception as error:
            message = readable_message(error, config_name)
            hydra_config = HydraConfig.get()
            if message is None:
                raise
            if hydra_config.mode != RunMode.MULTIRUN:  # Hydra would print the error before it raises it again
                _exit(message)
            # The other jobs go on; of an exception in another process only the message arrives.
            raise UserError(f"job {hydra_config.job.num}: {message}") from error

    os.environ[_FULL_ERROR] = "1"  # Hydra raises its errors instead of printing them
    try:
        with readable_errors(config_name):
            prepare()
            _application(task_with_readable_errors, config_name)()
    finally:
        del os.environ[_FULL_ERROR]


@contextmanager
def readable_errors(config_name: str, arguments: Sequence[str] | None = None) -> Iterator[None]:
    """Print an error that the user can fix as one message on stderr, and exit with 1; raise any other error again.

    Args:
        config_name: see `readable_message`.
        arguments: see `readable_message`.
    """
    try:
        yield
    except Exception as error:
        message = readable_message(error, config_name, arguments)
        if message is None:
            raise
        _exit(message)


def readable_message(error: Exception, config_name: str, arguments: Sequence[str] | None = None) -> str | None:
    """The message of an error that the user can fix; None if the error is a bug.

    Args:
        error: any exception.
        config_name: name of the primary config, to explain errors of Hydra and OmegaConf.
        arguments: the command line without the name of the program; None takes that of the process.
    """
    cause = error.__cause__ if isinstance(error, InstantiationException) else error
    if isinstance(cause, UserError) or _is_misconfiguration(error):
        return str(cause)
    if isinstance(error, InstantiationException):
        if not isinstance(cause, _SETTINGS_AT_FAULT) and not _is_misconfiguration(cause):
            return None
        key = next((line for line in str(error).splitlines() if line.startswith("full_key:")), "")
        return "  ".join(part for part in (str(cause), key.replace("full_key:", "in the config node")) if part)
    if isinstance(error, OverrideParseException):
        remedy = "a value with '=', ',' or spaces needs quotes: 'ckpt=\"a=b.ckpt\"'"
        return f"{error.override}: {error.message.splitlines()[0]}; {remedy}"
    if is_mistake(error):
        return explanation(error, config_name, sys.argv[1:] if arguments is None else arguments)
    return None


def _is_misconfiguration(error: BaseException | None) -> bool:
    """Whether it is Lightning's error. Compares names, so that evaluations need not wait for Lightning's import."""
    return any(base.__name__ == "MisconfigurationException" for base in type(error).__mro__)


def _application(task: Callable[[DictConfig], None], config_name: str) -> Callable[[], None]:
    return hydra.main(version_base="1.3", config_path=str(config_directory()), config_name=config_name)(task)


def _exit(message: str) -> NoReturn:
    print(f"error: {message}", file=sys.stderr, flush=True)
    sys.exit(1)
