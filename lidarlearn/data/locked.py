"""A file lock between processes."""

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from filelock import FileLock, Timeout


@contextmanager
def locked(file: Path, waiting: str) -> Iterator[None]:
    """Hold a lock; print a message if another process holds it.

    Args:
        file: of the lock; created if missing.
        waiting: the message.
    """
    lock = FileLock(file)
    try:
        lock.acquire(timeout=0)
    except Timeout:
        print(waiting, flush=True)
        lock.acquire()
    try:
        yield
    finally:
        lock.release()
