"""The run folder: its lock, and the configuration and code revision that every run writes beside its results."""

import subprocess
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from filelock import FileLock, Timeout
from hydra.utils import get_object
from omegaconf import DictConfig, OmegaConf

from lidarlearn.errors import UserError
from lidarlearn.source_digest import PACKAGE, source_digest

_SOURCE = Path(__file__).resolve().parent


def git_revision() -> str:
    """Commit of the running code, with "-modified" if files differ from it; "unknown" outside of a clone."""
    try:
        _git("ls-files", "--error-unmatch", __file__)  # a clone of this code, not a repository around its installation
        commit = _git("rev-parse", "HEAD")
        return f"{commit}-modified" if _git("status", "--porcelain", "--untracked-files=no") else commit
    except (OSError, subprocess.CalledProcessError):
        return "unknown"


def code_digest(*settings: Any) -> str:
    """Hash of the source code behind a result: of the package, and of classes from elsewhere that the settings name.

    Args:
        settings: plain values; each `_target_` outside of the package is included in the hash.

    Raises:
        UserError: a `_target_` does not exist.
    """
    others = sorted(target for target in set(_targets(settings)) if target.partition(".")[0] != PACKAGE.name)
    try:
        return source_digest(*PACKAGE.rglob("*.py"), *map(get_object, others))
    except ImportError as error:
        raise UserError(str(error)) from error


def checkpoints_in(folder: Path) -> list[Path]:
    """The checkpoints in a run folder; none if it is not that of a training."""
    return sorted((folder / "checkpoints").glob("*.ckpt"))


@contextmanager
def held_run_folder(folder: Path) -> Iterator[Path]:
    """Lock a run folder while this process writes results there.

    Args:
        folder: the run folder, created if missing.

    Raises:
        UserError: the folder is that of a training, or another process has locked it.
    """
    elsewhere = f"hydra.run.dir={folder / 'evaluation'}, or any other folder (hydra.sweep.dir or subdir with -m)"
    if checkpoints_in(folder):
        raise UserError(
            f"{folder} holds a training, whose config.yaml and git_revision.txt would be overwritten\n"
            f"  change: {elsewhere}"
        )
    folder.mkdir(parents=True, exist_ok=True)
    try:
        lock = FileLock(folder / ".lock").acquire(timeout=0)
    except Timeout:
        raise UserError(f"{folder}: another process writes its results there\n  change: {elsewhere}, or wait") from None
    with lock:
        yield folder


def write_run_description(folder: Path, config: DictConfig) -> None:
    """Write `config.yaml` with all settings of the run, and `git_revision.txt`."""
    folder.mkdir(parents=True, exist_ok=True)
    OmegaConf.save(config, folder / "config.yaml", resolve=True)
    (folder / "git_revision.txt").write_text(git_revision() + "\n", encoding="utf-8")


def _targets(settings: Any) -> Iterator[str]:
    """All `_target_`s in plain values."""
    if isinstance(settings, dict):
        if "_target_" in settings:
            yield str(settings["_target_"])
        settings = list(settings.values())
    if isinstance(settings, list | tuple):
        for value in settings:
            yield from _targets(value)


def _git(*arguments: str) -> str:
    command = ["git", "-C", str(_SOURCE), *arguments]
    return subprocess.run(command, check=True, capture_output=True, text=True).stdout.strip()
