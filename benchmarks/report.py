"""What all benchmarks share: options, tables and the JSON file."""

import argparse
import json
import os
import platform
import sys
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, field, fields
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from traceback import format_exc
from typing import Any

import torch
from rich.console import Console
from rich.markup import escape
from rich.table import Table

from lidarlearn.errors import UserError

_PACKAGES = ("torch", "kiss-icp", "small-gicp", "open3d")


@dataclass(frozen=True)
class Options:
    """The options of the command line.

    Args:
        quick: run a few scans once, to check correctness rather than speed.
        kitti: folder of KITTI odometry with sequence 04; None skips it.
        device: device of our own methods and networks.
    """

    quick: bool
    kitti: Path | None
    device: torch.device


Rows = Sequence[Any]  # dataclasses with a `column` for each field; None if there is nothing to measure
Benchmark = Callable[[Options], Rows]


def column(heading: str) -> Any:
    """A field of a row with the heading of its column, including the unit in brackets."""
    return field(metadata={"heading": heading})


def main(description: str | None, **benchmarks: Benchmark) -> None:
    """Run benchmarks, print a table for each and, with --json, write all of them to a file.

    If a benchmark fails, the others still run, and the exit code is 1.
    """
    parser = argparse.ArgumentParser(_program(), description=(description or "").partition("\n")[0].partition(": `")[0])
    parser.add_argument("--quick", action="store_true", help="a few scans once, to check correctness, not speed")
    parser.add_argument("--kitti", type=Path, help="folder of KITTI odometry with sequence 04")
    parser.add_argument("--json", type=Path, help="file to write the tables to")
    parser.add_argument("--device", default="cuda" if torch.cuda.is_available() else "cpu", help="cpu or cuda")
    arguments = parser.parse_args()
    options = Options(arguments.quick, arguments.kitti, torch.device(arguments.device))
    tables: dict[str, Any] = {}
    failures = []
    for name, measure in benchmarks.items():
        try:
            rows = measure(options)
        except Exception as error:
            rows = error.rows if isinstance(error, BenchmarkError) else ()
            failures.append(f"{name}: {error}" if isinstance(error, (BenchmarkError, UserError)) else format_exc())
        show(name, rows)
        tables[name] = [asdict(row) for row in rows]
        if arguments.json is not None:
            arguments.json.write_text(json.dumps({"about": about(options), **tables}, indent=2))
    if failures:
        sys.exit("error: " + "\n  ".join(failures))


def _program() -> str:
    """The program as it was called; argparse alone would print "__main__.py"."""
    spec = sys.modules["__main__"].__spec__
    return Path(sys.argv[0]).name if spec is None else f"python -m {spec.name.removesuffix('.__main__')}"


class BenchmarkError(Exception):
    """A result is wrong, not merely slow.

    Args:
        problem: what is wrong.
        rows: the measured rows.
    """

    def __init__(self, problem: str, rows: Rows) -> None:
        super().__init__(problem)
        self.rows = rows


def about(options: Options) -> dict[str, Any]:
    """The machine and the software behind the figures."""
    device = torch.cuda.get_device_name() if options.device.type == "cuda" else "cpu"
    found = {"python": platform.python_version(), "platform": platform.platform(), "device": device, "cpu": _cpu()}
    for package in _PACKAGES:
        try:
            found[package] = version(package)
        except PackageNotFoundError:
            found[package] = "not installed"
    return {**found, "cores": os.cpu_count(), "threads": torch.get_num_threads()}


def _cpu() -> str:
    """Name of the processor, which Linux states only in this file."""
    info = Path("/proc/cpuinfo")
    lines = info.read_text().splitlines() if info.is_file() else []
    names = [line.partition(":")[2].strip() for line in lines if line.startswith("model name")]
    return names[0] if names else platform.processor() or "unknown"


def show(title: str, rows: Rows) -> None:
    """Print the rows as a table, without empty columns."""
    table = Table(title=title)
    columns = [f for f in fields(rows[0]) if any(getattr(row, f.name) is not None for row in rows)] if rows else []
    for f in columns:
        is_text = isinstance(getattr(rows[0], f.name), str)
        table.add_column(escape(f.metadata["heading"]), justify="left" if is_text else "right")
    for row in rows:
        table.add_row(*(_cell(getattr(row, f.name)) for f in columns))
    Console().print(table)


def _cell(value: str | float | None) -> str:
    if value is None:
        return ""
    if isinstance(value, str):
        return value
    return f"{value:,.0f}" if abs(value) >= 100 else f"{value:.3g}"
