"""What can be wrong with a copy of a data set."""

from pathlib import Path

from lidarlearn.errors import UserError


class DataSetNotFoundError(UserError):
    """A data set, or a part of it that is needed, is not where it was looked for.

    Args:
        name: the data set, as its authors call it.
        missing: what was not found.
        looked_in: the path where it was looked for.
        source: where the data comes from.
        setting: the setting that says where to look.
    """

    def __init__(self, name: str, missing: str, looked_in: Path, source: str, setting: str = "data.root") -> None:
        super().__init__(
            f"{name}: {missing} not found.\n"
            f"  looked in: {looked_in.absolute()}\n"
            f"  change:    {setting}=/path/to/your/copy, or the environment variable LIDARLEARN_DATA\n"
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
