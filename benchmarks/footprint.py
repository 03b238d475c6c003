"""The time until the first scan is registered, and the memory of a long run."""

import statistics
import subprocess
import sys
import tempfile
import time
from dataclasses import dataclass
from pathlib import Path

from benchmarks import report
from benchmarks.odometry import METHODS
from benchmarks.report import column
from lidarlearn.commands.data import compose_data_set

_DRIVE = "urban_07"
_EVALUATE = Path(__file__).parents[1] / "evaluate.py"
_UNTIL_FIRST_SCAN = f"""
import os, runpy
import lidarlearn.odometry.odometry as odometry
odometry.Odometry.register_scan = lambda *_: os._exit(0)
runpy.run_path({str(_EVALUATE)!r}, run_name="__main__")
"""
# Linux's own count of this process: what it reports to its parent includes the memory of the parent before `exec`.
_WITH_PEAK = f"""
import runpy
try:
    runpy.run_path({str(_EVALUATE)!r}, run_name="__main__")
finally:
    print(next(line for line in open("/proc/self/status") if line.startswith("VmHWM")).split()[1])
"""


@dataclass(frozen=True)
class Row:
    """Seconds and peak memory of a separate process."""

    what: str = column("what")
    seconds: float | None = column("seconds")
    peak_rss_mib: float | None = column("peak RSS [MiB]")


def measure(options: report.Options) -> list[Row]:
    """Measure imports, the start of `evaluate.py`, and runs of 5,000 scans (60 with --quick) of a simulated town."""
    frames = 60 if options.quick else 5000
    with tempfile.TemporaryDirectory() as folder:
        data = ["data=simulated_urban", f"data.root={folder}", f"data.frames={frames}"]
        compose_data_set(data).prepare([_DRIVE])
        data += [f"data.test_sequences=[{_DRIVE}]", f"device={options.device}"]
        start = ["-c", _UNTIL_FIRST_SCAN, *data, f"methods=[{METHODS[0]}]", f"hydra.run.dir={folder}/start"]
        rows = [
            Row("import torch", _median_seconds(["-c", "import torch"], options), None),
            Row("import torch, lidarlearn", _median_seconds(["-c", "import torch, lidarlearn"], options), None),
            Row("import lidarlearn.odometry", _median_seconds(["-c", "import lidarlearn.odometry"], options), None),
            Row("evaluate.py to its first scan", _median_seconds(start, options), None),
        ]
        for method in METHODS:
            run = ["-c", _WITH_PEAK, *data, f"methods=[{method}]", f"hydra.run.dir={folder}/{method}"]
            seconds, output = _run(run)
            rows.append(Row(f"evaluate.py, {frames} scans, {method}", seconds, int(output.split()[-1]) / 2**10))
    return rows


def _median_seconds(arguments: list[str], options: report.Options) -> float:
    return statistics.median(_run(arguments)[0] for _ in range(1 if options.quick else 5))


def _run(arguments: list[str]) -> tuple[float, str]:
    """Seconds and output of a Python process."""
    start = time.perf_counter()
    done = subprocess.run([sys.executable, *arguments], stdout=subprocess.PIPE, text=True, check=True)
    return time.perf_counter() - start, done.stdout


if __name__ == "__main__":
    report.main(__doc__, footprint=measure)
