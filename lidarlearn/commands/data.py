"""`python -m lidarlearn.data check|export ...`: describe a copy of a data set, or write it in the format of another."""

import argparse
import json
import re
import shlex
import sys
from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path

from hydra import compose, initialize_config_dir
from hydra.utils import instantiate
from rich.console import Console
from rich.text import Text

from lidarlearn.commands.checkpoint_options import quoted
from lidarlearn.commands.configs import config_directory
from lidarlearn.commands.entry_point import readable_errors
from lidarlearn.data.layout import LayoutReport
from lidarlearn.data.sequence import DataSet
from lidarlearn.errors import UserError

_STYLES = {"found": "green", "odd": "yellow", "missing": "bold red"}
_USAGE = """usage:
  python -m lidarlearn.data check data=<data set> [data.root=/path/to/your/copy] [data.<setting>=...]
      says what is there, what is missing and what looks odd
  python -m lidarlearn.data export data=<data set> to=<data set> to.root=DIR [data.<setting>=...] [to.<setting>=...]
      writes the sequences of the one in the native format of the other; to=folder takes suffix=.bin|.npy|.pcd|.ply,
      where .bin and .npy hold no point times
  both take --config-dir DIR, a folder of your own data/<data set>.yaml"""
_ROLES = ("train", "val", "test")


def main(arguments: Sequence[str] | None = None) -> None:
    """Run one of the commands and exit, with 0 only if it succeeded.

    Args:
        arguments: the command, Hydra overrides of the group `data`, and optionally `--config-dir DIR` at any place;
            None takes the arguments of the process.
    """
    config_folder, rest = _without_config_dir(sys.argv[1:] if arguments is None else arguments)
    command, *overrides = rest or [""]
    console = Console(highlight=False, soft_wrap=True)
    wanted = {"check": ("data=",), "export": ("data=", "to=", "to.root=")}.get(command)
    with readable_errors("data", overrides):
        _require_folder(config_folder)
        if wanted is None or not all(any(o.startswith(w) for o in overrides) for w in wanted):
            console.print(f"{_USAGE}\ndata sets: {', '.join(data_groups(config_folder))}", markup=False)
            sys.exit(2)
        run = check if command == "check" else export_all
        succeeded = run(overrides, console, config_folder)
    sys.exit(0 if succeeded else 1)


def check(overrides: Sequence[str], console: Console, config_folder: str | None = None) -> bool:
    """Describe the data set that the overrides select, and return whether it is usable as configured."""
    report = compose_data_set(overrides, config_folder).full_check()
    show(report, console)
    return report.usable


def export_all(overrides: Sequence[str], console: Console, config_folder: str | None = None) -> bool:
    """Write the sequences of one data set in the format of another, and print the command that trains on them."""
    # imported late: a check does not need the libraries of the writers
    from lidarlearn.data.export.formats import exporter_of

    suffix = next((o.removeprefix("suffix=") for o in overrides if o.startswith("suffix=")), None)
    prefixes = ("to=", "to.", "projection@to.")
    of_target = [re.sub(r"^(projection@)?to\b", r"\1data", o) for o in overrides if o.startswith(prefixes)]
    of_source = [o for o in overrides if not o.startswith((*prefixes, "suffix="))]
    source, target = (compose_data_set(side, config_folder) for side in (of_source, of_target))
    exporter = exporter_of(target, suffix)
    theirs = matched_names(source, target)
    for name in theirs.values():
        exporter.require_new(name)
    source.prepare(theirs)
    drives = source.sequences(theirs)
    for mine, drive in drives.items():  # check all first: a partial export would block the next attempt
        exporter.require(drive, theirs[mine])
    for mine, drive in drives.items():
        exporter.export(drive, theirs[mine])
        console.print(f"{mine} -> {theirs[mine]}: {len(drive)} scans", markup=False)
    if left_out := [name for name in source.names if name not in theirs]:
        console.print(f"left out, {target.title} has no more names for them: {', '.join(left_out)}", markup=False)
    folder = [] if config_folder is None else ["--config-dir", config_folder]  # before all overrides
    words = ["python", "train.py", *folder, *of_target]
    if not any("projection" in o.partition("=")[0] for o in of_target):  # that of the exported scans
        ours, default = asdict(source.projection), asdict(target.projection)
        words += [f"data.projection.{key}={ours[key]}" for key in ours if ours[key] != default[key]]
    for role in _ROLES:
        names = [theirs[name] for name in getattr(source, f"{role}_sequences") if name in theirs]
        words.append(f"data.{role}_sequences={json.dumps(names)}")
    console.print(f"train on it: {shlex.join(words)}", markup=False)
    return True


def matched_names(source: DataSet, target: DataSet) -> dict[str, str]:
    """The name in the target for each sequence of the source.

    The n-th training sequence gets the n-th free name among the training sequences of the target, likewise for
    validation and test. Test and validation choose first, so that training takes none of their names. A folder of scans
    has no fixed names and keeps those of the source. A sequence is left out if no name is free.
    """
    if target.title == "folder of scans":
        return {name: name for name in source.names}
    matched: dict[str, str] = {}
    for role in reversed(_ROLES):
        for name in getattr(source, f"{role}_sequences"):
            free = (their for their in getattr(target, f"{role}_sequences") if their not in matched.values())
            if name not in matched and (their := next(free, None)) is not None:
                matched[name] = their
    return {name: matched[name] for name in source.names if name in matched}


def compose_data_set(overrides: Sequence[str], config_folder: str | None = None) -> DataSet:
    """The data set that Hydra overrides such as `data=nclt data.root=...` describe.

    Args:
        overrides: overrides of the group `data`.
        config_folder: a folder with further options of the user.

    Raises:
        HydraException, OmegaConfBaseException: no such data set or setting.
    """
    search_path = []
    if config_folder is not None:
        place = quoted(f"file://{Path(config_folder).absolute().as_posix()}")
        search_path = [f"hydra.searchpath=[{place}]"]
    with initialize_config_dir(str(config_directory().absolute()), version_base="1.3"):
        return instantiate(compose("data", [*overrides, *search_path]).data)


def data_groups(config_folder: str | None = None) -> list[str]:
    """The options of `data=`, including those in a folder of the user."""
    folders = [config_directory()] if config_folder is None else [config_directory(), Path(config_folder)]
    return sorted({path.stem for folder in folders for path in (folder / "data").glob("*.yaml")})


def show(report: LayoutReport, console: Console) -> None:
    """Print the findings, one per line, and the conclusion."""
    width = max((len(finding.what) for finding in report.findings), default=0)
    for finding in report.findings:
        line = Text(f"{finding.level:<8}", style=_STYLES[finding.level])
        console.print(line.append(f"{finding.what:<{width}}  {finding.detail}", style="default not bold"))
    if report.usable:
        console.print(Text("usable as configured", style="bold green"))
    else:
        missing = sum(finding.level == "missing" for finding in report.findings)
        remedy = report.remedy or "add what is listed as missing"
        console.print(Text(f"NOT usable as configured ({missing} missing). change: {remedy}", style="bold"))


def _without_config_dir(arguments: Sequence[str]) -> tuple[str | None, list[str]]:
    """The value of `--config-dir` at any place, and the other arguments."""
    parser = argparse.ArgumentParser(add_help=False, allow_abbrev=False)
    parser.add_argument("--config-dir", nargs="?", const="")
    flags, others = parser.parse_known_args(arguments)
    return flags.config_dir, others


def _require_folder(config_folder: str | None) -> None:
    if config_folder is not None and (not config_folder or not Path(config_folder).is_dir()):
        seen = f"no such folder: {Path(config_folder).absolute()}" if config_folder else "no folder is named"
        raise UserError(f"--config-dir: {seen}.\n  change: --config-dir to the folder that holds your data/*.yaml")
