"""Progress of tasks that process scans one by one: simulating, projecting, running an odometry, writing."""

import sys
import time
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from threading import Lock
from typing import TypeVar

from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

T = TypeVar("T")

_SECONDS_BETWEEN_LINES = 30.0


@contextmanager
def progress(what: str, total: int) -> Iterator[Callable[[], None]]:
    """Show the progress of a task.

    A terminal shows a bar, which disappears at the end. A file or a pipe gets a line at the start and then one every
    half minute, so that logs stay readable and a running task does not look finished.

    Args:
        what: name of the task, e.g. "projecting sequence 00".
        total: number of scans.

    Yields:
        A function to call after each scan, from any thread.
    """
    if sys.stdout.isatty():
        description = TextColumn("{task.description}", markup=False)
        columns = (description, BarColumn(), MofNCompleteColumn(), TextColumn("scans"), TimeRemainingColumn())
        with Progress(*columns, transient=True) as bars:
            bar = bars.add_task(what, total=total)
            yield lambda: bars.advance(bar)
        return
    print(f"{what}: {total:,} scans", flush=True)
    done, shown, lock = 0, time.monotonic(), Lock()

    def advance() -> None:
        nonlocal done, shown
        with lock:
            done += 1
            if done < total and time.monotonic() - shown >= _SECONDS_BETWEEN_LINES:
                shown = time.monotonic()
                print(f"{what}: {done:,} of {total:,} scans", flush=True)

    yield advance


def tracked(items: Iterable[T], what: str, total: int) -> Iterator[T]:
    """Iterate over the items and show the progress."""
    with progress(what, total) as advance:
        for item in items:
            yield item
            advance()
