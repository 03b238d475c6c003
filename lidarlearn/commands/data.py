"""`python -m lidarlearn.data check|export ...`: describe a copy of a data set, or write it in the format of another."""

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
_USAGE = """usage:
  python -m lidarlearn.data check data=<data set> [data.root=/path/to/your/copy] [data.<setting>=...]
      says what is there, what is missing and what looks odd
  python -m lidarlearn.data export data=<data set> to=<data set> to.root=DIR [data.<setting>=...] [to.<setting>=...]
      writes the sequences of the one in the native format of the other; to=folder takes suffix=.bin|.npy|.pcd|.ply"""
_ROLES = ("train", "val", "test")


def main(arguments: Sequence[str] | None = None) -> None:
    """Run one of the commands; exits with 0 only where it succeeded.

    Args:
        arguments: the command and Hydra overrides of the group `data`; None takes those of the process.
    """
    command, *overrides = (sys.argv[1:] if arguments is None else arguments) or [""]
    console = Console(highlight=False, soft_wrap=True)
    wanted = {"check": ("data=",), "export": ("data=", "to=", "to.root=")}.get(command)
    if wanted is None or not all(any(o.startswith(w) for o in overrides) for w in wanted):
        console.print(f"{_USAGE}\ndata sets: {', '.join(data_groups())}", markup=False)
        sys.exit(2)
    try:
        succeeded = check(overrides, console) if command == "check" else export_all(overrides, console)
    except (UserError, HydraException, OmegaConfBaseException) as error:
        console.print(f"error: {_message(error)}", markup=False)
        sys.exit(1)
    sys.exit(0 if succeeded else 1)


def check(overrides: Sequence[str], console: Console) -> bool:
    """Describe the data set that the overrides select; whether it can be used as configured."""
    report = compose_data_set(overrides).check()
    show(report, console)
    return report.usable


def export_all(overrides: Sequence[str], console: Console) -> bool:
    """Write the sequences of one data set in the format of another, and say how to train on them."""
    # imported late: the writers' libraries are of no use to a check
    from lidarlearn.data.export.formats import export

    settings = dict(o.split("=", 1) for o in overrides if o.startswith("suffix="))
    source = compose_data_set([o for o in overrides if not o.startswith(("to=", "to.", "suffix="))])
    of_target = [o for o in overrides if o.startswith(("to=", "to."))]
    target = compose_data_set([o.replace("to", "data", 1) for o in of_target])
    source.prepare()
    written: dict[str, list[str]] = {role: [] for role in _ROLES}
    for role, of_source, of_target_name in matched_sequences(source, target):
        if any(of_target_name in names for names in written.values()):
            console.print(f"{of_source} ({role}) is left out: there is a {of_target_name} already", markup=False)
        else:
            drive = source.sequence(of_source)
            export(drive, target, of_target_name, **settings)
            console.print(f"{of_source} ({role}) -> {of_target_name}: {len(drive)} scans", markup=False)
        written[role].append(of_target_name)
    names = " ".join(f"'data.{role}_sequences=[{','.join(map(repr, names))}]'" for role, names in written.items())
    selection = next(o for o in of_target if o.startswith("to=")).replace("to", "data", 1)
    root = next(o for o in of_target if o.startswith("to.root=")).removeprefix("to.root=")
    console.print(f"train on it: python train.py {selection} data.root={root} {names}", markup=False)
    return True


def matched_sequences(source: DataSet, target: DataSet) -> list[tuple[str, str, str]]:
    """What each sequence is used for, its name, and its name in the target.

    The n-th training sequence becomes the target's n-th, and so on; where the target lacks names of its own (a folder
    of scans), names stay. A sequence beyond the target's last one is left out.
    """
    matches = []
    for role in _ROLES:
        names: tuple[str, ...] = getattr(source, f"{role}_sequences")
        theirs = names if target.title == "folder of scans" else getattr(target, f"{role}_sequences")
        matches += [(role, mine, their) for mine, their in zip(names, theirs, strict=False)]
    return matches


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
