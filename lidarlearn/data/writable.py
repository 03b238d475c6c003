"""Folders that can be written to, and files that are whole or absent."""

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from tempfile import TemporaryFile

from lidarlearn.errors import UserError


@contextmanager
def atomic_write(path: Path) -> Iterator[Path]:
    """The path of a draft beside `path`, which takes its place at the end: `path` is never half written."""
    draft = path.with_suffix(".tmp")
    yield draft
    draft.replace(path)


def writable(folder: Path, remedy: str) -> Path:
    """The folder, made where it is missing.

    Args:
        folder: to write to.
        remedy: which setting to change where that is not possible.

    Raises:
        UserError: it cannot be made, or not be written to.
    """
    try:
        folder.mkdir(parents=True, exist_ok=True)
        with TemporaryFile(dir=folder):  # permissions are not the only reason: a mount may be read-only
            return folder
    except OSError as error:
        raise UserError(f"{folder.absolute()} cannot be written to: {error.strerror}.\n  change: {remedy}") from error
