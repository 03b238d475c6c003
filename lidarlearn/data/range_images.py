"""Range images of simulated drives: their files, and making them in several threads."""

import copy
import os
import threading
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import ThreadPoolExecutor, as_completed
from contextlib import contextmanager
from pathlib import Path

import numpy as np

from lidarlearn.data.writable import atomic_write
from lidarlearn.progress import progress
from lidarlearn.simulation.drive import Drive


def image_path(folder: Path, index: int) -> Path:
    """The file of one range image."""
    return folder / f"{index:06d}.npy"


def missing_images(folder: Path, indices: Iterable[int]) -> list[int]:
    """The indices of scans that have no file yet."""
    existing = {entry.name for entry in os.scandir(folder)} if folder.is_dir() else set()
    return [i for i in indices if image_path(folder, i).name not in existing]


def make_images(jobs: list[tuple[Drive, Path, list[int]]], workers: int) -> None:
    """Simulate and write scans, showing progress; several workers share a drive if there are fewer drives than workers.

    Args:
        jobs: for each drive its settings, the folder of its images, and the indices to make.
        workers: number of threads.
    """
    parts = max(1, workers // len(jobs))
    shared = [(_SharedDrive(drive, parts), folder, indices) for drive, folder, indices in jobs]
    portions = [(drive, folder, indices[k::parts]) for drive, folder, indices in shared for k in range(parts)]
    total = sum(len(indices) for _, _, indices in jobs)
    stop = threading.Event()
    # Threads are enough, and need no importable main module: ray casting and numpy's loops release the GIL.
    what = f"simulating {len(jobs)} drive{'s' if len(jobs) > 1 else ''}"
    with progress(what, total) as advance, ThreadPoolExecutor(max(1, workers)) as pool:
        running = {pool.submit(_work, *portion, stop, advance) for portion in portions}
        try:
            for future in as_completed(running):
                future.result()
        finally:
            stop.set()
            pool.shutdown(cancel_futures=True)


class _SharedDrive:
    """A drive whose world, which may take gigabytes, is built once for all its users and freed after the last one.

    Args:
        drive: the settings.
        users: how many times `built` will be entered.
    """

    def __init__(self, drive: Drive, users: int) -> None:
        self._drive, self._left, self._lock = copy.copy(drive), users, threading.Lock()

    @contextmanager
    def built(self) -> Iterator[Drive]:
        """The drive with its world, for one of the users."""
        with self._lock:
            self._drive.build()
        try:
            yield self._drive
        finally:
            with self._lock:
                self._left -= 1
                if not self._left:
                    self._drive = copy.copy(self._drive)  # without the world, which is not copied


def _work(
    shared: _SharedDrive, folder: Path, indices: list[int], stop: threading.Event, advance: Callable[[], None]
) -> None:
    with shared.built() as drive:
        for index in indices:
            if stop.is_set():
                return
            with atomic_write(image_path(folder, index)) as draft, draft.open("wb") as file:
                np.save(file, drive.ranges(index))
            advance()
