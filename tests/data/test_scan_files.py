import os

import numpy as np
import pytest

from lidarlearn.commands.data import data_groups
from lidarlearn.data.errors import DamagedFileError
from lidarlearn.data.scan_files import gaps, list_scans, natural_key, read_float32_rows, sequence_names
from lidarlearn.errors import UserError
from tests.data.datasets import data_set
from tests.data.writers import random_points, write_float32


def test_scans_are_in_natural_order(tmp_path):
    for name in ("scan_10.bin", "scan_9.bin", "scan_100.bin", ".scan_1.bin", "notes.txt"):
        (tmp_path / name).write_bytes(b"x" * 16)
    scans = list_scans(tmp_path, (".bin",))
    assert scans.names == ("scan_9.bin", "scan_10.bin", "scan_100.bin")
    assert scans.numbers == [9, 10, 100]
    assert scans.first(2).names == ("scan_9.bin", "scan_10.bin")


SECONDS = ["1583836591.22498.bin", "1583836592.0.bin", "1583836592.119722.bin", "1583836592.22498.bin"]
NANOSECONDS = ["1583836591.1190722000.bin", "1583836592.22498.bin", "1583836592.119722000.bin"]


@pytest.mark.parametrize(
    "names",
    [SECONDS, [f"scan_{name}" for name in SECONDS], NANOSECONDS],
    ids=["seconds", "prefix", "nanoseconds"],
)
def test_scans_named_by_unix_time_are_in_order_of_time(tmp_path, names):
    """Floats as Python prints them, without trailing zeros; or nanoseconds without leading zeros."""
    for name in sorted(names):
        (tmp_path / name).touch()
    assert list(list_scans(tmp_path, (".bin",)).names) == names


@pytest.mark.parametrize(
    ("names", "counted"),
    [
        (SECONDS, False),
        (["1326030975726043.bin", "1326030975925839.bin"], False),
        (["cloud_1583836591_182590976.bin"], False),
        (["0000000010.bin", "0000000012.bin"], True),
        (["scan7.bin"], True),
    ],
    ids=["seconds", "microseconds", "seconds_nanoseconds", "digits", "prefix"],
)
def test_names_of_times_are_not_scan_numbers(tmp_path, names, counted):
    for name in names:
        (tmp_path / name).touch()
    assert list_scans(tmp_path, (".bin",)).counted == counted


def test_absent_folder_holds_no_scans(tmp_path):
    assert len(list_scans(tmp_path / "nowhere", (".bin",))) == 0


@pytest.mark.parametrize("name", [name for name in data_groups() if not name.startswith("simulated")])
def test_unreadable_folders_and_circular_links_are_ignored(name, tmp_path, monkeypatch):
    """Such as lost+found. Permissions do not stop a superuser, who may run the tests: the calls are replaced."""
    (tmp_path / "lost+found").mkdir()
    for link in ("circle", "circle.bin", "circle.bag"):
        (tmp_path / link).symlink_to(link)

    def closed(look):
        def looks(path, **options):
            if "lost+found" in str(path):
                raise PermissionError(13, "Permission denied", str(path))
            return look(path, **options)

        return looks

    access = os.access
    monkeypatch.setattr(os, "access", lambda path, mode: "lost+found" not in str(path) and access(path, mode))
    monkeypatch.setattr(os, "scandir", closed(os.scandir))
    monkeypatch.setattr(os, "stat", closed(os.stat))
    for root in (tmp_path, tmp_path / "lost+found", tmp_path / "lost+found" / "closed"):
        assert not data_set(name, root).full_check().usable
    assert not any(len(list_scans(tmp_path / closed, (".bin",))) for closed in ("lost+found", "circle"))


def test_natural_key_orders_by_number_then_text():
    assert sorted(["b2", "a10", "a9", "a09"], key=natural_key) == ["a09", "a9", "a10", "b2"]
    assert sorted(["lot 10²", "②", "lot 9", "①"], key=natural_key) == ["lot 9", "lot 10²", "①", "②"]


@pytest.mark.parametrize(
    ("given", "expected"),
    [(["09", 10], ("09", "10")), (4, ("04",)), ("08", ("08",)), ([], ())],
    ids=str,
)
def test_sequence_names_pad_numbers_with_zeros(given, expected):
    assert sequence_names(given, digits=2) == expected


@pytest.mark.parametrize("name", ["/etc/passwd", "../00", "a/b", "a\\b", "..", ""])
def test_sequence_names_refuse_paths(name):
    with pytest.raises(UserError, match="no name of a sequence"):
        sequence_names(["00", name])


def test_gaps_in_scan_numbers():
    assert gaps([3, 4, 7, 9]) == [(5, 6), (8, 8)]
    assert gaps([5, 6, 7]) == []


def test_fingerprint_depends_on_files_and_settings_only(tmp_path):
    for folder in ("a", "b"):
        write_float32(tmp_path / folder / "0.bin", random_points(0))
    a, b = (list_scans(tmp_path / folder, (".bin",)) for folder in ("a", "b"))
    assert a.fingerprint("R", angle=1.0) == b.fingerprint("R", angle=1.0)
    assert a.fingerprint("R", angle=1.0) != a.fingerprint("R", angle=2.0)
    assert a.fingerprint("R", angle=1.0) != a.fingerprint("S", angle=1.0)
    write_float32(tmp_path / "b" / "0.bin", random_points(0)[:-1])
    assert a.fingerprint("R") != list_scans(tmp_path / "b", (".bin",)).fingerprint("R")


@pytest.mark.parametrize("changed", ["0.bin", "5.bin", "9.bin"])
def test_fingerprint_distinguishes_files_of_equal_size(tmp_path, changed):
    for i in range(10):
        write_float32(tmp_path / f"{i}.bin", random_points(i))
    before = list_scans(tmp_path, (".bin",)).fingerprint("R")
    write_float32(tmp_path / changed, random_points(99))
    assert list_scans(tmp_path, (".bin",)).fingerprint("R") != before


def test_read_float32_rows_returns_written_rows(tmp_path):
    points = random_points(0)
    write_float32(tmp_path / "0.bin", points, columns=5)
    rows = read_float32_rows(tmp_path / "0.bin", columns=5)
    assert np.array_equal(rows[:, :3], points)


@pytest.mark.parametrize(
    ("content", "problem"),
    [
        (b"", "empty"),
        (b"\0" * 37, "truncated"),
        (np.array([1, 2, np.nan, 0], "<f4").tobytes(), "1 of 1 points are not finite"),
        (np.array([1, np.inf, 2, 0], "<f4").tobytes(), "not finite"),
    ],
)
def test_damaged_rows_error_names_file(tmp_path, content, problem):
    path = tmp_path / "000007.bin"
    path.write_bytes(content)
    with pytest.raises(DamagedFileError, match=problem) as caught:
        read_float32_rows(path, columns=4)
    assert "000007.bin" in str(caught.value)


def test_missing_file_raises_damaged_file_error(tmp_path):
    with pytest.raises(DamagedFileError, match="cannot be read"):
        read_float32_rows(tmp_path / "gone.bin", columns=4)
