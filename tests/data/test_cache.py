"""The cache of vertex maps."""

import errno
import importlib
import multiprocessing
import os
import pickle
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from lidarlearn.data import cache
from lidarlearn.data.cache import QUANTUM_M, VertexMaps, cached_vertex_maps, decode, encode, require_room
from lidarlearn.data.errors import DamagedFileError
from lidarlearn.data.sequence import Scan
from lidarlearn.errors import UserError
from lidarlearn.geometry.projection import SphericalProjection, activated
from lidarlearn.source_digest import source_digest
from tests.box_world import SMALL, BoxSequence


class CountingSequence(BoxSequence):
    """Records which scans are read; one may be damaged, or interrupt the process."""

    def __init__(self, frames=7, damaged=None, interrupted=None):
        super().__init__("1", frames)
        self.read, self.damaged, self.interrupted = [], damaged, interrupted

    def scan(self, index) -> Scan:
        if index == self.damaged:
            raise DamagedFileError(Path("scan.bin"), "it is truncated")
        if index == self.interrupted:
            raise KeyboardInterrupt
        self.read.append(index)
        return super().scan(index)


def test_cached_maps_equal_projected_scans_to_half_quantum(tmp_path):
    sequence = BoxSequence("1", frames=4)
    maps = cached_vertex_maps(sequence, SMALL, tmp_path)
    assert len(maps) == 4 and maps[0].dtype == torch.int16
    for i in range(4):
        exact = SMALL.vertex_map(sequence.scan(i).points)
        assert (decode(maps[i]) - exact).abs().max() <= QUANTUM_M / 2 + 1e-6
        assert (activated(decode(maps[i])) == activated(exact)).all()


def test_frame_of_64x720_takes_at_most_280_kb(tmp_path):
    cached_vertex_maps(BoxSequence("1", frames=3), SphericalProjection(), tmp_path)
    assert sum(f.stat().st_size for f in tmp_path.rglob("*") if f.is_file()) <= 3 * 280_000


def test_points_beyond_16_bit_range_become_empty_pixels():
    vertex_map = torch.tensor([[131.0, 132.0, -200.0], [1.0, 1.0, 1.0], [0.0, 0.0, 0.0]])[:, None]
    kept = activated(decode(encode(vertex_map)))
    assert kept.tolist() == [[True, False, False]]


def test_second_call_reads_no_scans(tmp_path):
    sequence = CountingSequence()
    cached_vertex_maps(sequence, SMALL, tmp_path)
    cached_vertex_maps(sequence, SMALL, tmp_path)
    assert sequence.read == list(range(7))


def test_other_projection_or_length_makes_new_cache(tmp_path):
    sequence = CountingSequence(frames=3)
    for projection in (SMALL, replace(SMALL, width=48), replace(SMALL, fov_up_deg=10.0)):
        assert cached_vertex_maps(sequence, projection, tmp_path)[0].shape == (3, 16, projection.width)
    longer = CountingSequence(frames=4)
    cached_vertex_maps(longer, SMALL, tmp_path)
    assert len(sequence.read) == 9 and len(longer.read) == 4


def test_interrupted_cache_is_continued(tmp_path, monkeypatch):
    monkeypatch.setattr(cache, "_CHUNK", 2)
    with pytest.raises(KeyboardInterrupt):
        cached_vertex_maps(CountingSequence(interrupted=5), SMALL, tmp_path)
    again = CountingSequence()
    maps = cached_vertex_maps(again, SMALL, tmp_path)
    assert again.read == [4, 5, 6]  # chunks of two: 0 to 3 were done
    for i in range(7):
        torch.testing.assert_close(maps[i], encode(SMALL.vertex_map(again.scan(i).points)))


@pytest.mark.parametrize("file", ["vertex_maps.npy", "done.npy"])
@pytest.mark.parametrize("left", [None, 0, 40, 0.5, 0.99])
@pytest.mark.parametrize("complete", [True, False])
def test_missing_or_truncated_file_is_rebuilt(tmp_path, file, left, complete):
    cached_vertex_maps(CountingSequence(), SMALL, tmp_path)
    path = next(tmp_path.rglob(file))
    if not complete:  # one frame is missing
        done = np.lib.format.open_memmap(path.with_name("done.npy"), mode="r+")
        done[5] = False
        done.flush()
    if left is None:
        path.unlink()
    else:
        whole = path.read_bytes()
        path.write_bytes(whole[: left if isinstance(left, int) else int(left * len(whole))])
    again = CountingSequence()
    maps = cached_vertex_maps(again, SMALL, tmp_path)
    assert again.read == list(range(7))
    for i in range(7):
        torch.testing.assert_close(maps[i], encode(SMALL.vertex_map(again.scan(i).points)))


def test_changed_reader_code_makes_new_cache(tmp_path, monkeypatch):
    first = cached_vertex_maps(CountingSequence(), SMALL, tmp_path)
    digests = []
    monkeypatch.setattr(cache, "source_digest", lambda *origins: digests.append(origins) or "of other code")
    again = CountingSequence()
    assert cached_vertex_maps(again, SMALL, tmp_path).files != first.files and again.read == list(range(7))
    assert digests[0] == (CountingSequence, Path(cache.__file__))


def test_changed_import_of_reader_makes_new_cache(tmp_path, monkeypatch):
    (tmp_path / "my_reader.py").write_text(
        "from my_scale import SCALE\n"
        "from lidarlearn.data.sequence import Scan\n"
        "from tests.box_world import BoxSequence\n"
        "class Scaled(BoxSequence):\n"
        "    def scan(self, index):\n"
        "        return Scan(super().scan(index).points * SCALE)\n"
    )
    monkeypatch.syspath_prepend(tmp_path)
    ranges = []
    for scale in (1.0, 0.5):
        (tmp_path / "my_scale.py").write_text(f"SCALE = {scale}{'  ' * int(1 / scale)}\n")
        for name in ("my_reader", "my_scale"):  # as in another process
            monkeypatch.delitem(sys.modules, name, raising=False)
        source_digest.cache_clear()
        sequence = importlib.import_module("my_reader").Scaled("1", frames=2)
        ranges.append(decode(cached_vertex_maps(sequence, SMALL, tmp_path)[0]).norm(dim=0).max())
    torch.testing.assert_close(ranges[1], ranges[0] / 2, rtol=0, atol=0.01)


# fork beside torch's threads, from Python 3.12 on
@pytest.mark.filterwarnings("ignore:This process:DeprecationWarning")
@pytest.mark.parametrize("num_workers", [0, 2])
def test_damaged_scan_error_names_file(tmp_path, num_workers):
    with pytest.raises(UserError, match=r"scan\.bin: it is truncated") as raised:
        cached_vertex_maps(CountingSequence(damaged=3), SMALL, tmp_path, num_workers)
    assert "Traceback" not in str(raised.value)


def test_full_disk_is_refused_with_setting(tmp_path, monkeypatch):
    usage = type("usage", (), {"free": 1000})
    monkeypatch.setattr(cache.shutil, "disk_usage", lambda _: usage)
    with pytest.raises(UserError, match=r"datamodule\.cache_root"):
        cached_vertex_maps(CountingSequence(), SMALL, tmp_path)


def test_file_is_allocated_before_first_scan_is_read(tmp_path):
    with pytest.raises(KeyboardInterrupt):
        cached_vertex_maps(CountingSequence(interrupted=0), SMALL, tmp_path)
    file = next(tmp_path.rglob("vertex_maps.npy")).stat()
    assert 512 * file.st_blocks >= file.st_size


def test_failed_allocation_leaves_no_file(tmp_path, monkeypatch):
    def full(*_):
        raise OSError(errno.ENOSPC, "No space left on device")

    sequence = CountingSequence()
    with monkeypatch.context() as patched:
        patched.setattr(cache.os, "posix_fallocate", full)
        with pytest.raises(UserError, match=r"No space left on device\.\n  change: datamodule\.cache_root"):
            cached_vertex_maps(sequence, SMALL, tmp_path)
    assert sequence.read == [] and not list(tmp_path.rglob("vertex_maps.npy"))
    assert len(cached_vertex_maps(sequence, SMALL, tmp_path)) == 7


@pytest.mark.parametrize(("maps", "fit"), [(2.9, True), (1.9, False)])
def test_require_room_counts_missing_maps_of_all_sequences(tmp_path, monkeypatch, maps, fit):
    frames = 7 * 3 * SMALL.height * SMALL.width * 2
    cached_vertex_maps(BoxSequence("0", frames=7), SMALL, tmp_path)
    usage = type("usage", (), {"free": int(50_000_000 + maps * frames)})
    monkeypatch.setattr(cache.shutil, "disk_usage", lambda _: usage)
    sequences = [BoxSequence(name, frames=7) for name in "012"]
    if fit:
        require_room(sequences, SMALL, tmp_path)
    else:
        with pytest.raises(UserError, match=r"0\.05 GB are free(.|\n)*0\.05 GB that are left to others"):
            require_room(sequences, SMALL, tmp_path)


def test_maps_are_pickled_as_path(tmp_path):
    maps = cached_vertex_maps(BoxSequence("1", frames=30), SMALL, tmp_path)
    luggage = pickle.dumps(maps)
    assert len(luggage) < 2000
    torch.testing.assert_close(pickle.loads(luggage)[29], maps[29])


def test_maps_may_exceed_memory(tmp_path):
    memory = os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES")
    count = 4 * memory // (2 * 3 * 64 * 1024)
    np.lib.format.open_memmap(tmp_path / "0.npy", mode="w+", dtype=np.int16, shape=(count, 3, 64, 1024))  # sparse
    assert not VertexMaps(tmp_path / "0.npy")[torch.tensor([0, count - 1])].any()


def _build(root, start, results):
    torch.set_num_threads(1)
    sequence = CountingSequence(frames=12)
    start.wait()
    maps = cached_vertex_maps(sequence, SMALL, root)
    results.put((len(sequence.read), int(np.abs(maps[11].numpy()).sum())))


# fork beside torch's threads, from Python 3.12 on
@pytest.mark.filterwarnings("ignore:This process:DeprecationWarning")
def test_concurrent_processes_project_each_scan_once(tmp_path):
    context = multiprocessing.get_context("fork")
    start, results = context.Event(), context.Queue()
    processes = [context.Process(target=_build, args=(tmp_path, start, results)) for _ in range(2)]
    for process in processes:
        process.start()
    start.set()
    (read_a, sum_a), (read_b, sum_b) = (results.get(timeout=60) for _ in range(2))
    for process in processes:
        process.join()
    assert sorted([read_a, read_b]) == [0, 12]
    assert sum_a == sum_b == int(encode(SMALL.vertex_map(BoxSequence("1", 12).scan(11).points)).int().abs().sum())
