import re
import subprocess
import sys

import pytest

from lidarlearn.commands.data import compose_data_set, data_groups, main
from lidarlearn.data.sequence import DataSet
from lidarlearn.errors import UserError
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

# data sets whose files have names of their own, a writer of each, and a sequence that it writes
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
    """What is said on stderr, and nothing on stdout, which others may read."""
    with pytest.raises(SystemExit) as exited:
        main(arguments)
    printed = capsys.readouterr()
    assert exited.value.code == 1 and not printed.out and printed.err.startswith("error: ")
    return printed.err.removeprefix("error: ")


@pytest.mark.parametrize("name", DATA_ON_DISK)
def test_every_data_set_composes_and_has_an_answer_to_an_absent_root(name, tmp_path, capsys):
    data = compose_data_set([f"data={name}"])
    assert isinstance(data, DataSet)
    assert not set(data.val_sequences) & set(data.test_sequences) or name in ("folder", "rosbag")
    code, printed = run(capsys, "check", f"data={name}", f"data.root={tmp_path / 'nowhere'}")
    assert code == 1 and "no such folder" in printed and "data.root" in printed


@pytest.mark.parametrize("name", SPLITS)
def test_kitti_is_split_as_in_the_paper(name):
    data = compose_data_set([f"data={name}"])
    train, test = SPLITS[name]
    assert list(data.train_sequences) == train and list(data.test_sequences) == test
    assert set(data.val_sequences) <= set(train)


def test_nclt_is_split_as_in_the_paper():
    data = compose_data_set(["data=nclt"])
    assert len(data.train_sequences) == 10
    assert (min(data.train_sequences), max(data.train_sequences)) == ("2012-01-22", "2012-03-31")
    assert data.test_sequences == ("2012-01-08",)
    assert set(data.val_sequences) <= set(data.train_sequences)


def test_sequence_numbers_from_the_command_line():
    assert compose_data_set(["data=kitti_00-08", "data.test_sequences=[04,10,08]"]).test_sequences == ("04", "10", "08")


@pytest.mark.parametrize(
    ("name", "write", "sequence"),
    [
        *PUBLISHED,
        ("folder", lambda root: write_float32(root / "drive" / "0.bin", [[1, 2, 3]]), "drive"),
        ("rosbag", lambda root: write_bag(root, "drive", {"/points": [CLOUD]}), "drive"),
    ],
)
def test_a_whole_copy_is_usable_and_a_partial_one_is_described(tmp_path, capsys, name, write, sequence):
    write(tmp_path)
    code, printed = run(capsys, "check", f"data={name}", f"data.root={tmp_path}", *only(sequence))
    assert code == 0 and sequence in printed and "usable as configured" in printed
    code, printed = run(capsys, "check", f"data={name}", f"data.root={tmp_path}", *only("9999"))
    assert code == 1 and "missing 9999" in printed and "NOT usable" in printed
    assert f"({sequence})" in printed  # what there is instead


@pytest.mark.parametrize(("name", "write", "sequence"), PUBLISHED)
def test_scans_with_other_names_are_shown(tmp_path, capsys, name, write, sequence):
    write(tmp_path)
    data = compose_data_set([f"data={name}", f"data.root={tmp_path}", *only(sequence)])
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
@pytest.mark.parametrize("count", ["0", "-1"])
def test_no_data_set_takes_no_scans_for_a_number_of_scans(capsys, name, count):
    error = error_of(capsys, "check", f"data={name}", f"data.max_frames={count}")
    assert f"data.max_frames={count}" in error and error.endswith("at least 1\n")


@pytest.mark.parametrize("count", ["0", "null"])
def test_a_simulated_drive_needs_a_scan(count):
    command = [sys.executable, "-m", "lidarlearn.data", "check", "data=simulated_urban", f"data.frames={count}"]
    done = subprocess.run(command, stderr=subprocess.PIPE, text=True)  # here, hints of types are checked, too
    assert done.returncode == 1 and f"error: data.frames={count}:" in done.stderr and "at least 1" in done.stderr


@pytest.mark.parametrize("name", data_groups())
def test_one_sequence_needs_no_brackets_and_a_root_may_begin_at_home(name, tmp_path, monkeypatch):
    monkeypatch.setenv("HOME", str(tmp_path))
    data = compose_data_set([f"data={name}", "data.test_sequences=urban_07", "data.root='~/scans'"])
    assert data.test_sequences == ("urban_07",) and data.root == tmp_path / "scans"


def test_a_simulated_name_that_is_none_is_found_by_the_check(capsys):
    code, printed = run(capsys, "check", "data=simulated_urban", "data.test_sequences=[town_1]")
    assert code == 1 and "no simulated sequence 'town_1'" in printed and "data.test_sequences to names" in printed


@pytest.fixture
def my_configs(tmp_path):
    place = tmp_path / "my configs, $all" / "data" / "mine.yaml"
    place.parent.mkdir(parents=True)
    place.write_text("defaults:\n  - folder\n  - override /projection@projection: vlp16\n  - _self_\n")
    write_float32(tmp_path / "scans" / "drive" / "0.bin", [[1, 2, 0.1]])
    return place.parent.parent


@pytest.mark.parametrize("place", [0, 1, 2, 3])
@pytest.mark.parametrize("written", [("--config-dir", "{}"), ("--config-dir={}",)])
def test_a_data_set_in_a_folder_of_ones_own(my_configs, tmp_path, capsys, place, written):
    arguments = ["check", "data=mine", f"data.root={tmp_path}/scans"]
    arguments[place:place] = [word.format(my_configs) for word in written]
    code, printed = run(capsys, *arguments)
    assert code == 0 and "usable as configured" in printed
    overrides = ["data=mine", f"data.root={tmp_path}/scans"]
    assert compose_data_set(overrides, str(my_configs)).projection.height == 16


def test_a_folder_of_ones_own_may_be_named_from_where_one_is(my_configs, tmp_path, capsys, monkeypatch):
    monkeypatch.chdir(tmp_path)
    code, printed = run(capsys, "check", "data=mine", "data.root=scans", "--config-dir", my_configs.name)
    assert code == 0 and "usable as configured" in printed


def test_data_sets_of_ones_own_are_listed(my_configs, capsys):
    code, printed = run(capsys, "check", "--config-dir", str(my_configs))
    assert code == 2 and "take --config-dir DIR" in printed and "kitti_raw, mine, nclt" in printed


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (["--config-dir", "nowhere", "check", "data=mine"], "no such folder: {}/nowhere"),
        (["check", "data=mine", "--config-dir=mine.yaml"], "no such folder: {}/mine.yaml"),
        (["check", "data=mine", "--config-dir"], "no folder is named"),
    ],
)
def test_a_folder_of_ones_own_that_is_not_there(tmp_path, capsys, monkeypatch, arguments, said):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "mine.yaml").touch()
    assert error_of(capsys, *arguments).startswith("--config-dir: " + said.format(tmp_path))


@pytest.mark.parametrize(("arguments", "said"), [([], "usage"), (["data=nclt"], "usage"), (["check"], "kitti_00-08")])
def test_a_command_that_lacks_something_prints_the_usage(capsys, arguments, said):
    code, printed = run(capsys, *arguments)
    assert code == 2 and said in printed


@pytest.mark.parametrize(
    ("overrides", "said"),
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
def test_mistakes_are_explained_as_those_of_evaluate_py_are(capsys, overrides, said):
    error = error_of(capsys, "check", *overrides)
    assert error.startswith(said) and "append" not in error


def test_a_data_set_that_is_not_there_is_sought_among_ones_own_too(my_configs, capsys):
    error = error_of(capsys, "check", "data=mien", "--config-dir", str(my_configs))
    assert "\n    kitti_raw\n    mine\n    nclt\n" in error


def test_the_command_itself(tmp_path):
    command = [sys.executable, "-m", "lidarlearn.data", "check", "data=kitti_00-08", f"data.root={tmp_path}"]
    finished = subprocess.run(command, capture_output=True, text=True)
    assert finished.returncode == 1
    assert "holds no folder 'sequences'" in finished.stdout and "Traceback" not in finished.stdout + finished.stderr
