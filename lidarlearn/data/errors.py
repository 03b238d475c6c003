"""What can be wrong with a copy of a data set."""

from pathlib import Path

from lidarlearn.errors import UserError

ROOT_REMEDY = (
    "data.root=/path/to/your/copy, or the environment variable LIDARLEARN_DATA to the folder that holds"
    " kitti_odometry, kitti_raw, nclt, ..."
)


class DataSetNotFoundError(UserError):
    """A data set, or a part of it that is needed, is not where it was looked for.

    Args:
        name: the data set, as its authors call it.
        missing: what was not found.
        looked_in: the path where it was looked for.
        source: where the data comes from.
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
    """A file is there but cannot be what it should be.

    Args:
        path: the file.
        problem: what was seen and what was expected.
        remedy: what to do about it.
    """

    def __init__(self, path: Path, problem: str, remedy: str = "copy or download this file again") -> None:
        super().__init__(f"{path.absolute()}: {problem}.\n  change: {remedy}")


def one_line(message: object) -> str:
    """An error's message for a table or a list."""
    return " ".join(line.strip() for line in str(message).splitlines())


def require_count(setting: str, value: int | None, optional: bool = False) -> None:
    """Raise UserError unless a setting is an integer of at least 1, or None where that is allowed."""
    if (value is None and optional) or (isinstance(value, int) and value >= 1):
        return
    seen = "null" if value is None else value
    raise UserError(f"{setting}={seen}: no number of scans.\n  change: {setting} to an integer of at least 1")
