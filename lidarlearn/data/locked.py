"""A file lock between processes."""

from contextlib import AbstractContextManager
from pathlib import Path

from filelock import FileLock, Timeout


def locked(file: Path, waiting: str) -> AbstractContextManager[object]:
    """Take a lock, to be held in a `with` block; prints a message if another process holds it.

    Args:
        file: of the lock; created if missing.
        waiting: the message.
    """
    lock = FileLock(file)
    try:
        return lock.acquire(timeout=0)
    except Timeout:
        print(waiting, flush=True)
        return lock.acquire()
