"""Progress of what goes scan by scan and may take minutes: simulating, projecting, running an odometry, writing."""

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
    """Show how far something is; the function it gives is called after each scan, from any thread.

    On a terminal a bar that goes away at the end. Into a file or a pipe a line at once, and one now and then, so that
    a log stays readable and nobody takes a long silence for the end.

    Args:
        what: is done, e.g. "projecting sequence 00".
        total: number of scans.
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
    """The items, with their progress shown."""
    with progress(what, total) as advance:
        for item in items:
            yield item
            advance()
