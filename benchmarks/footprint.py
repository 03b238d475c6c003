"""What a user waits for and pays before any scan is registered, and how much memory a long run takes."""

import os
import statistics
import subprocess
import sys
import tempfile
import time
from dataclasses import dataclass
from pathlib import Path

from benchmarks import report
from benchmarks.report import column

_METHODS = ("cv+kd_f2m", "cv+vh_f2m", "cv+p_f2m")
_EVALUATE = Path(__file__).parents[1] / "evaluate.py"
# evaluate.py until it hands its first scan to the odometry
_UNTIL_FIRST_SCAN = f"""
import os, runpy, sys
import lidarlearn.odometry.odometry as odometry
odometry.Odometry.register_scan = lambda *_: os._exit(0)
runpy.run_path({str(_EVALUATE)!r}, run_name="__main__")
"""


@dataclass(frozen=True)
class Row:
    """Seconds or memory of a process of its own."""

    what: str = column("what")
    seconds: float | None = column("seconds")
    peak_rss_mib: float | None = column("peak RSS [MiB]")


def measure(options: report.Options) -> list[Row]:
    """Imports, the start of `evaluate.py`, and an odometry run of 5,000 scans (60 with --quick) of a simulated town."""
    frames = 60 if options.quick else 5000
    with tempfile.TemporaryDirectory() as folder:
        data = ["data=simulated_urban", f"data.root={folder}", f"data.frames={frames}", f"device={options.device}"]
        rows = [
            Row("import torch", _median_seconds(["-c", "import torch"], options), None),
            Row("import torch, lidarlearn", _median_seconds(["-c", "import torch, lidarlearn"], options), None),
            Row("import lidarlearn.odometry", _median_seconds(["-c", "import lidarlearn.odometry"], options), None),
        ]
        simulate = [str(_EVALUATE), *data, "data.max_frames=2", f"methods=[{_METHODS[0]}]", f"hydra.run.dir={folder}/0"]
        _run(simulate)
        start = ["-c", _UNTIL_FIRST_SCAN, *data, f"methods=[{_METHODS[0]}]", f"hydra.run.dir={folder}/start"]
        rows.append(Row("evaluate.py to its first scan", _median_seconds(start, options), None))
        for method in _METHODS:
            seconds, rss = _run([str(_EVALUATE), *data, f"methods=[{method}]", f"hydra.run.dir={folder}/{method}"])
            rows.append(Row(f"evaluate.py, {frames} scans, {method}", seconds, rss))
    return rows


def _median_seconds(arguments: list[str], options: report.Options) -> float:
    return statistics.median(_run(arguments)[0] for _ in range(1 if options.quick else 5))


def _run(arguments: list[str]) -> tuple[float, float]:
    """Seconds and peak resident memory [MiB] of a Python process."""
    start = time.perf_counter()
    process = subprocess.Popen([sys.executable, *arguments], stdout=subprocess.DEVNULL)
    _, status, usage = os.wait4(process.pid, 0)
    process.returncode = os.waitstatus_to_exitcode(status)
    if process.returncode:
        raise subprocess.CalledProcessError(process.returncode, arguments)
    unit = 2**20 if sys.platform == "darwin" else 2**10
    return time.perf_counter() - start, usage.ru_maxrss / unit


if __name__ == "__main__":
    report.main(__doc__, footprint=measure)
