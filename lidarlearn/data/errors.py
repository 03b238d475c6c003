"""Errors about the copy of a data set."""

from pathlib import Path

from lidarlearn.errors import UserError

ROOT_REMEDY = (
    "data.root=/path/to/your/copy, or the environment variable LIDARLEARN_DATA to the folder that holds"
    " kitti_odometry, kitti_raw, nclt, ..."
)


class DataSetNotFoundError(UserError):
    """A data set, or a required part of it, was not found.

    Args:
        name: of the data set, as its authors call it.
        missing: what was not found.
        looked_in: path at which it was expected.
        source: where to get the data.
        remedy: which setting to change.
    """

    def __init__(self, name: str, missing: str, looked_in: Path, source: str, remedy: str = ROOT_REMEDY) -> None:
        super().__init__(
            f"{name}: {missing} not found.\n"
            f"  looked in: {looked_in.absolute()}\n"
            f"  change:    {remedy}\n"
            f"  get it:    {source}"
        )


class DamagedFileError(UserError):
    """A file exists but its content is not what it should be.

    Args:
        path: the file.
        problem: what was found and what was expected.
        remedy: what to do about it.
    """

    def __init__(self, path: Path, problem: str, remedy: str = "copy or download this file again") -> None:
        super().__init__(f"{path.absolute()}: {problem}.\n  change: {remedy}")


def one_line(message: object) -> str:
    """The message of an error on one line, for a table or a list."""
    return " ".join(line.strip() for line in str(message).splitlines())


def require_count(setting: str, value: int | None, optional: bool = False) -> None:
    """Raise a UserError unless a setting is an integer of at least 1, or None if that is allowed."""
    if (value is None and optional) or (isinstance(value, int) and value >= 1):
        return
    seen = "null" if value is None else value
    raise UserError(f"{setting}={seen}: not a number of scans.\n  change: {setting} to an integer of at least 1")
