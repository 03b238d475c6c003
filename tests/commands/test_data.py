"""`python -m lidarlearn.data check`, and the data sets that its command line describes."""

import re
import runpy
import subprocess
import sys

import pytest
from hydra.errors import InstantiationException

from lidarlearn.commands.data import compose_data_set, data_groups, main
from lidarlearn.data.sequence import DataSet
from lidarlearn.errors import UserError
from tests.data.datasets import data_set
from tests.data.writers import (
    as_rows,
    random_points,
    write_bag,
    write_float32,
    write_ford_campus,
    write_kitti_360,
    write_kitti_odometry,
    write_kitti_raw,
    write_nclt,
    write_newer_college,
)

DATA_ON_DISK = [name for name in data_groups() if not name.startswith("simulated")]
ODOMETRY = [f"{i:02d}" for i in range(22)]
SPLITS = {
    "kitti_00-08": (ODOMETRY[:9], ODOMETRY[9:11]),
    "kitti_11-21": (ODOMETRY[11:], ODOMETRY[:11]),
    "kitti_00-21": (ODOMETRY, ODOMETRY[:11]),
    "kitti_00_02-10": (ODOMETRY[:1] + ODOMETRY[2:11], ["01"]),
    "kitti_00_02-21": (ODOMETRY[:1] + ODOMETRY[2:], ["01"]),
}
CLOUD = as_rows(random_points(0), [(axis, "<f4") for axis in "xyz"])

# data sets with fixed file names, a writer of each, and a sequence that it writes
PUBLISHED = (
    ("kitti_00-08", write_kitti_odometry, "04"),
    ("kitti_raw", write_kitti_raw, "2011_09_26_drive_0009"),
    ("kitti_360", write_kitti_360, "0003"),
    ("newer_college", write_newer_college, "01_short_experiment"),
    ("nclt", write_nclt, "2012-01-08"),
    ("ford_campus", write_ford_campus, "IJRR-Dataset-1"),
)


def only(name):
    return [f"data.{split}_sequences=[{name}]" for split in ("train", "val", "test")]


def run(capsys, *arguments):
    with pytest.raises(SystemExit) as exited:
        main(arguments)
    return exited.value.code, capsys.readouterr().out


def error_of(capsys, *arguments):
    """The error on stderr; stdout stays empty, since other programs may read it."""
    with pytest.raises(SystemExit) as exited:
        main(arguments)
    printed = capsys.readouterr()
    assert exited.value.code == 1 and not printed.out and printed.err.startswith("error: ")
    return printed.err.removeprefix("error: ")


@pytest.mark.parametrize("name", DATA_ON_DISK)
def test_check_reports_missing_root(name, tmp_path, capsys):
    code, printed = run(capsys, "check", f"data={name}", f"data.root={tmp_path / 'nowhere'}")
    assert code == 1 and "no such folder" in printed and "data.root" in printed


@pytest.mark.parametrize("name", DATA_ON_DISK)
def test_validation_and_test_sequences_are_disjoint(name):
    data = data_set(name)
    assert isinstance(data, DataSet)
    assert not set(data.val_sequences) & set(data.test_sequences) or name in ("folder", "rosbag")


@pytest.mark.parametrize("name", SPLITS)
def test_kitti_splits_are_those_of_the_paper(name):
    data = data_set(name)
    train, test = SPLITS[name]
    assert list(data.train_sequences) == train and list(data.test_sequences) == test
    assert set(data.val_sequences) <= set(train)


def test_nclt_split_is_that_of_the_paper():
    data = data_set("nclt")
    assert len(data.train_sequences) == 10
    assert (min(data.train_sequences), max(data.train_sequences)) == ("2012-01-22", "2012-03-31")
    assert data.test_sequences == ("2012-01-08",)
    assert set(data.val_sequences) <= set(data.train_sequences)


def test_sequence_numbers_are_padded():
    assert compose_data_set(["data=kitti_00-08", "data.test_sequences=[04,10,08]"]).test_sequences == ("04", "10", "08")


@pytest.mark.parametrize(
    ("name", "write", "sequence"),
    [
        *PUBLISHED,
        ("folder", lambda root: write_float32(root / "drive" / "0.bin", [[1, 2, 3]]), "drive"),
        ("rosbag", lambda root: write_bag(root, "drive", {"/points": [CLOUD]}), "drive"),
    ],
)
def test_check_accepts_whole_copy_and_names_missing_sequence(tmp_path, capsys, name, write, sequence):
    write(tmp_path)
    code, printed = run(capsys, "check", f"data={name}", f"data.root={tmp_path}", *only(sequence))
    assert code == 0 and sequence in printed and "usable as configured" in printed
    code, printed = run(capsys, "check", f"data={name}", f"data.root={tmp_path}", *only("9999"))
    assert code == 1 and "missing 9999" in printed and "NOT usable" in printed
    assert f"({sequence})" in printed  # the sequences that exist


@pytest.mark.parametrize(("name", "write", "sequence"), PUBLISHED)
def test_check_shows_unexpected_scan_names(tmp_path, capsys, name, write, sequence):
    write(tmp_path)
    data = data_set(name, tmp_path, sequence)
    scans = data.found()[sequence]
    for number in range(len(scans)):
        scans.path(number).rename(scans.folder / f"my_{number}{scans.path(number).suffix}")
    seen = f"({len(scans)} files there, none named like {scans.like}: 'my_0."
    example = scans.folder / scans.like
    code, printed = run(capsys, "check", f"data={name}", f"data.root={tmp_path}", *only(sequence))
    assert code == 1 and seen in printed
    with pytest.raises(UserError, match=re.escape(seen)):
        data.sequence(sequence)
    example.write_bytes(b"")
    assert data.found()[sequence].names == (scans.like,)


@pytest.mark.parametrize("name", data_groups())
@pytest.mark.parametrize("count", [0, -1])
def test_data_set_refuses_max_frames_below_one(name, count):
    with pytest.raises(InstantiationException, match=rf"data\.max_frames={count}\b.*at least 1"):
        data_set(name, max_frames=count)


@pytest.mark.parametrize("setting", ["max_frames", "frames"])
def test_check_refuses_simulated_drive_without_scans(capsys, setting):
    error = error_of(capsys, "check", "data=simulated_urban", f"data.{setting}=0")
    assert error.startswith(f"data.{setting}=0") and error.endswith("at least 1\n")


@pytest.mark.slow
def test_check_refuses_null_frames():
    """In a process of its own, where type hints are not checked before the value is."""
    command = [sys.executable, "-m", "lidarlearn.data", "check", "data=simulated_urban", "data.frames=null"]
    done = subprocess.run(command, stderr=subprocess.PIPE, text=True)
    assert done.returncode == 1 and "error: data.frames=null:" in done.stderr and "at least 1" in done.stderr


@pytest.mark.parametrize("name", data_groups())
def test_data_set_accepts_single_sequence_and_home_folder(name, tmp_path, monkeypatch):
    monkeypatch.setenv("HOME", str(tmp_path))
    data = data_set(name, test_sequences="urban_07", root="~/scans")
    assert data.test_sequences == ("urban_07",) and data.root == tmp_path / "scans"


def test_command_line_accepts_single_sequence_and_home_folder(tmp_path, monkeypatch):
    monkeypatch.setenv("HOME", str(tmp_path))
    data = compose_data_set(["data=kitti_00-08", "data.test_sequences=urban_07", "data.root='~/scans'"])
    assert data.test_sequences == ("urban_07",) and data.root == tmp_path / "scans"


def test_check_refuses_unknown_simulated_sequence(capsys):
    code, printed = run(capsys, "check", "data=simulated_urban", "data.test_sequences=[town_1]")
    assert code == 1 and "no simulated sequence 'town_1'" in printed and "data.test_sequences to names" in printed


@pytest.fixture
def config_dir(tmp_path):
    """A folder with a data set of the user, whose name needs quotes; its scans lie beside it."""
    folder = tmp_path / "my configs, $all"
    (folder / "data").mkdir(parents=True)
    (folder / "data" / "mine.yaml").write_text(
        "defaults:\n  - folder\n  - override /projection@projection: vlp16\n  - _self_\n"
    )
    write_float32(tmp_path / "scans" / "drive" / "0.bin", [[1, 2, 0.1]])
    return folder


@pytest.mark.parametrize(
    ("place", "flag"),
    [*((place, ["--config-dir", "{}"]) for place in range(4)), (0, ["--config-dir={}"]), (3, ["--config-dir={}"])],
)
def test_check_accepts_config_dir_at_any_place(config_dir, tmp_path, capsys, place, flag):
    arguments = ["check", "data=mine", f"data.root={tmp_path}/scans"]
    arguments[place:place] = [word.format(config_dir) for word in flag]
    code, printed = run(capsys, *arguments)
    assert code == 0 and "usable as configured" in printed


def test_config_dir_overrides_projection(config_dir):
    assert compose_data_set(["data=mine"], str(config_dir)).projection.height == 16


def test_config_dir_may_be_relative(config_dir, tmp_path, capsys, monkeypatch):
    monkeypatch.chdir(tmp_path)
    code, printed = run(capsys, "check", "data=mine", "data.root=scans", "--config-dir", config_dir.name)
    assert code == 0 and "usable as configured" in printed


def test_usage_lists_data_sets_of_config_dir(config_dir, capsys):
    code, printed = run(capsys, "check", "--config-dir", str(config_dir))
    assert code == 2 and "take --config-dir DIR" in printed and "kitti_raw, mine, nclt" in printed


def test_unknown_data_set_error_lists_those_of_config_dir(config_dir, capsys):
    error = error_of(capsys, "check", "data=mien", "--config-dir", str(config_dir))
    assert "\n    kitti_raw\n    mine\n    nclt\n" in error


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--config-dir", "nowhere", "check", "data=mine"], "no such folder: {}/nowhere"),
        (["check", "data=mine", "--config-dir=mine.yaml"], "no such folder: {}/mine.yaml"),
        (["check", "data=mine", "--config-dir"], "no folder is named"),
    ],
)
def test_missing_config_dir_is_refused(tmp_path, capsys, monkeypatch, arguments, message):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "mine.yaml").touch()
    assert error_of(capsys, *arguments).startswith("--config-dir: " + message.format(tmp_path))


@pytest.mark.parametrize(("arguments", "shown"), [([], "usage"), (["data=nclt"], "usage"), (["check"], "kitti_00-08")])
def test_incomplete_command_prints_usage(capsys, arguments, shown):
    code, printed = run(capsys, *arguments)
    assert code == 2 and shown in printed


@pytest.mark.parametrize(
    ("overrides", "message"),
    [
        (["data=nclt2"], "there is no data=nclt2; did you mean data=nclt?\n  options:\n    folder\n"),
        (["data=nclt", "data.deskw=true"], "there is no setting or group 'data.deskw'; did you mean data.deskew?"),
        (["data=nclt", "data.train_sequences=["], "data.train_sequences=["),
        (
            ["data=nclt", "projection@data.projection=hdl46"],
            "there is no projection=hdl46; did you mean projection=hdl",
        ),
    ],
)
def test_typo_is_explained(capsys, overrides, message):
    error = error_of(capsys, "check", *overrides)
    assert error.startswith(message) and "append" not in error


def test_module_runs_the_command(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(sys, "argv", ["data", "check", "data=kitti_00-08", f"data.root={tmp_path}"])
    with pytest.raises(SystemExit) as exited:
        runpy.run_module("lidarlearn.data", run_name="__main__")
    assert exited.value.code == 1 and "holds no folder 'sequences'" in capsys.readouterr().out
