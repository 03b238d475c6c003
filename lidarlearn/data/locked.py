"""What one process makes while others wait for it."""

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from filelock import FileLock, Timeout


@contextmanager
def locked(file: Path, waiting: str) -> Iterator[None]:
    """Hold a lock; say so when another process makes this one wait.

    Args:
        file: of the lock; made where missing.
        waiting: what is said then.
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
