"""`python -m lidarlearn.data check data=<group> data.root=...`: describe a copy of a data set before relying on it."""

import sys
from collections.abc import Sequence

from hydra import compose, initialize_config_dir
from hydra.errors import HydraException, InstantiationException
from hydra.utils import instantiate
from omegaconf.errors import OmegaConfBaseException
from rich.console import Console
from rich.text import Text

from lidarlearn.commands.configs import config_directory
from lidarlearn.data.sequence import DataSet, LayoutReport
from lidarlearn.errors import UserError

_STYLES = {"found": "green", "odd": "yellow", "missing": "bold red"}
_USAGE = "python -m lidarlearn.data check data=<data set> [data.root=/path/to/your/copy] [data.<setting>=...]"


def main(arguments: Sequence[str] | None = None) -> None:
    """Describe the data set that the overrides select; exits with 0 only where it can be used as configured.

    Args:
        arguments: "check" and Hydra overrides of the group `data`; None takes those of the process.
    """
    arguments = sys.argv[1:] if arguments is None else arguments
    console = Console(highlight=False, soft_wrap=True)
    if not arguments or arguments[0] != "check" or not any(a.startswith("data=") for a in arguments):
        console.print(f"usage: {_USAGE}\ndata sets: {', '.join(data_groups())}", markup=False)
        sys.exit(2)
    try:
        report = compose_data_set(arguments[1:]).check()
    except (UserError, HydraException, OmegaConfBaseException) as error:
        console.print(f"error: {_message(error)}", markup=False)
        sys.exit(1)
    show(report, console)
    sys.exit(0 if report.usable else 1)


def compose_data_set(overrides: Sequence[str]) -> DataSet:
    """The data set that Hydra overrides such as `data=nclt data.root=...` describe.

    Raises:
        HydraException, OmegaConfBaseException: no such data set or setting.
    """
    # Without a primary config there is no default to replace: the group is added.
    added = [f"+{override}" if override.startswith("data=") else override for override in overrides]
    with initialize_config_dir(str(config_directory().absolute()), version_base="1.3"):
        return instantiate(compose(overrides=added).data)


def data_groups() -> list[str]:
    """Names that `data=` takes."""
    return sorted(path.stem for path in (config_directory() / "data").glob("*.yaml"))


def show(report: LayoutReport, console: Console) -> None:
    """Print the findings, one a line, and what follows from them."""
    width = max((len(finding.what) for finding in report.findings), default=0)
    for finding in report.findings:
        line = Text(f"{finding.level:<8}", style=_STYLES[finding.level])
        console.print(line.append(f"{finding.what:<{width}}  {finding.detail}", style="default not bold"))
    if report.usable:
        console.print(Text("usable as configured", style="bold green"))
    else:
        missing = sum(finding.level == "missing" for finding in report.findings)
        remedy = report.remedy or "mend what is listed as missing"
        console.print(Text(f"NOT usable as configured ({missing} missing). change: {remedy}", style="bold"))


def _message(error: Exception) -> str:
    if isinstance(error, InstantiationException) and error.__cause__ is not None:
        return str(error.__cause__)
    return str(error).partition("\nConfig search path:")[0]
