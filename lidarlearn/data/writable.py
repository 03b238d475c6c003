"""Checking that a folder can be written to, and writing files atomically."""

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from tempfile import TemporaryFile

from lidarlearn.errors import UserError


@contextmanager
def atomic_write(path: Path) -> Iterator[Path]:
    """The path of a draft that replaces `path` at the end, so that `path` is never half written."""
    draft = path.with_suffix(".tmp")
    yield draft
    draft.replace(path)


def writable(folder: Path, remedy: str) -> Path:
    """The folder, created if missing.

    Args:
        folder: to write to.
        remedy: which setting to change if that is not possible.

    Raises:
        UserError: the folder cannot be created or written to.
    """
    try:
        folder.mkdir(parents=True, exist_ok=True)
        with TemporaryFile(dir=folder):  # permissions are not enough: a mount may be read-only
            return folder
    except OSError as error:
        raise UserError(f"{folder.absolute()} cannot be written to: {error.strerror}.\n  change: {remedy}") from error
