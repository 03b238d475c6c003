"""Bags written by `rosbags`, with point clouds in the layouts of drivers."""

import json
import pickle
import sqlite3
import subprocess
import sys
from contextlib import closing
from multiprocessing import get_context

import numpy as np
import pytest
import torch

from lidarlearn.commands import evaluate
from lidarlearn.data.bag_files import find_bags
from lidarlearn.data.cache import cached_vertex_maps
from lidarlearn.data.errors import DamagedFileError, DataSetNotFoundError
from lidarlearn.errors import UserError
from lidarlearn.geometry.projection import SphericalProjection
from lidarlearn.simulation.drive import Drive
from lidarlearn.simulation.sensors import os1_64
from tests import scenes
from tests.data.bags import KINDS, OUSTER, PLAIN, TIMES_NS, first_x, plain_clouds, rosbag
from tests.data.datasets import findings
from tests.data.writers import as_rows, curve, kitti_rows, random_points, tum_rows, write_bag
from tests.odometry.odometries import build, motion_errors, poses


@pytest.mark.parametrize(
    ("kind", "compression"),
    [(kind, None) for kind in KINDS] + [("ros1", "bz2"), ("ros1", "lz4"), ("sqlite3", "MESSAGE"), ("mcap", "STORAGE")],
)
def test_round_trip(tmp_path, kind, compression):
    clouds = [as_rows(random_points(i), OUSTER, intensity=100, t=TIMES_NS) for i in range(4)]
    write_bag(tmp_path, "street", {"/points": clouds, "/chatter": ["hello"] * 4}, kind, compression=compression)
    sequence = rosbag(tmp_path, max_intensity=200).sequence("street")
    assert len(sequence) == 4 and sequence.T_world_lidar is None
    for i in (3, 0, 2, 1, 2):
        scan = sequence.scan(i)
        assert np.array_equal(scan.points, random_points(i)) and scan.points.dtype == torch.float32
        assert np.allclose(scan.times, np.linspace(-0.495, 0.495, 200), atol=1e-6)  # 99 ms of 100
        assert (scan.intensities == 0.5).all()
    assert np.allclose(sequence.timestamps, 1.6e9 + 0.0495 + 0.1 * np.arange(4), rtol=0, atol=1e-6)


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize(
    ("fields", "row_padding"),
    [
        ([(axis, ">f4") for axis in "xyz"] + [("time", ">f8")], 0),
        ([("timestamp", "<f8"), *((axis, "<f8") for axis in "zyx")], 0),
        ([("X", "<f4"), ("Y", "<f4"), ("Z", "<f4"), ("", "u1"), ("offset_time", "<u4")], 13),
    ],
    ids=["big endian", "float64 zyx", "padded rows"],
)
def test_clouds_in_layouts_of_other_drivers(tmp_path, kind, fields, row_padding):
    """Organised in 4 rows; three points without a return."""
    points = random_points(0).reshape(4, 50, 3)
    points[0, 7], points[3, 2], points[2, 5, 0] = 0, np.nan, np.inf
    rows = np.zeros((4, 50), dtype=fields)
    for i, axis in enumerate("xyz"):
        rows[axis if axis in rows.dtype.names else axis.upper()] = points[..., i]
    stamped = next(name for name in rows.dtype.names if "time" in name)
    rows[stamped] = np.arange(50)
    write_bag(tmp_path, "street", {"/points": [rows, rows]}, kind, row_padding=row_padding)
    scan = rosbag(tmp_path).sequence("street").scan(1)
    kept = np.isfinite(points).all(-1) & (points != 0).any(-1)
    assert kept.sum() == 197
    assert np.array_equal(scan.points, points[kept])
    assert np.allclose(scan.times, (np.broadcast_to(np.arange(50), (4, 50))[kept] - 24.5) / 100)  # ms
    assert scan.intensities is None


def test_each_bag_in_folder_is_a_sequence(tmp_path):
    write_bag(tmp_path, "run_10", {"/points": plain_clouds(2)})
    write_bag(tmp_path, "run_9", {"/points": plain_clouds(3)}, "mcap")
    (tmp_path / "notes").mkdir()
    data = rosbag(tmp_path)
    assert data.train_sequences == data.val_sequences == data.test_sequences == ("run_9", "run_10")
    assert [len(data.sequence(name)) for name in data.names] == [3, 2]
    assert data.sequence("run_9") is data.sequence("run_9")  # reading through a bag is slow
    assert len(rosbag(tmp_path, max_frames=2).sequence("run_9")) == 2
    assert rosbag(tmp_path, test_sequences="run_9").test_sequences == ("run_9",)
    with pytest.raises(DataSetNotFoundError, match=r"run_9, run_10"):
        data.sequence("run_11")


@pytest.mark.parametrize("kind", KINDS)
def test_root_may_be_a_single_bag(tmp_path, kind, monkeypatch):
    path = write_bag(tmp_path, "2024.05.01", {"/points": plain_clouds(2)}, kind)
    assert rosbag(path).names == ("2024.05.01",)
    assert len(rosbag(path).sequence("2024.05.01")) == 2 and rosbag(path).check().usable
    if kind != "ros1":
        (storage,) = (file for file in path.iterdir() if file.name != "metadata.yaml")
        assert len(rosbag(storage).sequence("2024.05.01")) == 2  # without the metadata
        monkeypatch.chdir(path)
        assert len(rosbag(".").sequence("2024.05.01")) == 2
        (path / "notes").mkdir()
        monkeypatch.chdir(path / "notes")
        assert rosbag("..").names == ("2024.05.01",)


def test_folder_of_split_bag_is_one_sequence(tmp_path):
    late, early = plain_clouds(2, first=3), plain_clouds(3)
    write_bag(tmp_path / "street", "a", {"/points": late}, start_s=1.6e9 + 0.3)
    write_bag(tmp_path / "street", "b", {"/points": early, "/chatter": ["hello"]})
    sequence = rosbag(tmp_path).sequence("street")
    assert all(np.array_equal(scan.points, random_points(i)) for i, scan in enumerate(sequence)) and len(sequence) == 5
    write_bag(tmp_path, "other", {"/points": early}, "mcap")
    (tmp_path / "other" / "other.mcap").rename(tmp_path / "street" / "c.mcap")
    with pytest.raises(UserError, match="several kinds"):
        rosbag(tmp_path).sequence("street")


@pytest.mark.parametrize(
    ("later_s", "warning"), [(13, "are 10 s apart"), (1.5, "overlap by 1 s"), (3, None), (2.5, None)]
)
def test_split_bag_with_gap_or_overlap_is_warned_about(tmp_path, later_s, warning, caplog):
    for name, start_s in (("run1", 1.6e9), ("run2", 1.6e9 + later_s)):
        write_bag(tmp_path / "day", name, {"/points": plain_clouds(30)}, start_s=start_s)
    report = rosbag(tmp_path).check()
    assert report.usable and len(rosbag(tmp_path).sequence("day")) <= 60
    for text in (findings(report, "odd"), caplog.text):
        assert (f"data.root={tmp_path / 'day'}" in text) == (warning is not None)
        assert warning is None or f"two of them {warning}" in text
    assert rosbag(tmp_path / "day").names == ("run1", "run2")


@pytest.mark.parametrize("kind", ["sqlite3", "mcap"])
def test_file_compressed_bag_error_names_convert_command(tmp_path, kind):
    path = write_bag(tmp_path, "street", {"/points": plain_clouds(3)}, kind, compression="FILE")
    with pytest.raises(UserError, match=f"rosbags-convert --src {path} "):
        rosbag(tmp_path).sequence("street")
    assert "compressed as a whole" in findings(rosbag(tmp_path).check(), "missing")
    convert = [sys.executable, "-m", "rosbags.convert", "--src", path, "--dst", tmp_path / "unpacked"]
    subprocess.run(convert, check=True)
    assert len(rosbag(tmp_path).sequence("unpacked")) == 3


def test_bags_of_equal_name_keep_suffix(tmp_path):
    write_bag(tmp_path, "run", {"/points": plain_clouds(2)})
    write_bag(tmp_path, "run", {"/points": plain_clouds(3)}, "sqlite3")
    assert {name: len(rosbag(tmp_path).sequence(name)) for name in find_bags(tmp_path)} == {"run": 3, "run.bag": 2}
    (tmp_path / "run.txt").write_text(kitti_rows(curve(3)))
    assert rosbag(tmp_path).sequence("run").T_world_lidar is not None
    assert rosbag(tmp_path).sequence("run.bag").T_world_lidar is None


@pytest.mark.parametrize("kind", KINDS)
def test_topic_must_be_chosen_among_several(tmp_path, kind):
    topics = {"/front": plain_clouds(2), "/rear": plain_clouds(3), "/chatter": ["hello"], "/silent": []}
    write_bag(tmp_path, "street", topics, kind)
    with pytest.raises(UserError, match=r"data\.topic to one of /front \(.*, 2 messages\), /rear \(.*, 3 messages\)$"):
        rosbag(tmp_path).sequence("street")
    assert len(rosbag(tmp_path, topic="/rear").sequence("street")) == 3
    for absent in ("/side", "/chatter", "/silent"):
        with pytest.raises(UserError, match=f"no point clouds in topic {absent}\\.\n.*to one of /front"):
            rosbag(tmp_path, topic=absent).sequence("street")
    report = rosbag(tmp_path).check()
    assert not report.usable and "several topics hold point clouds" in findings(report, "missing")
    assert "/chatter (std_msgs/msg/String, 1 messages)" in findings(report, "found")
    write_bag(tmp_path, "silence", {}, kind)
    assert "no PointCloud2" in findings(rosbag(tmp_path).check(), "missing")


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("topics", [{}, {"/points": []}, {"/chatter": ["hello"]}], ids=str)
def test_bag_without_point_clouds_is_refused(tmp_path, kind, topics):
    write_bag(tmp_path, "street", topics, kind)
    with pytest.raises(UserError, match="no PointCloud2 messages"):
        rosbag(tmp_path).sequence("street")
    assert "no PointCloud2 messages" in findings(rosbag(tmp_path).check(), "missing")


def test_messages_without_points_are_skipped(tmp_path):
    clouds = plain_clouds(4)
    clouds[1] = clouds[1][:0]
    write_bag(tmp_path, "street", {"/points": clouds})
    (tmp_path / "street.txt").write_text(kitti_rows(curve(3)))
    sequence = rosbag(tmp_path).sequence("street")
    assert [bool((scan.points.numpy() == random_points(i)).all()) for i, scan in zip((0, 2, 3), sequence, strict=True)]
    assert np.allclose(sequence.T_world_lidar, curve(3))
    assert len(rosbag(tmp_path, max_frames=2).sequence("street").T_world_lidar) == 2
    report = rosbag(tmp_path).check()
    assert report.usable and "3 poses for 4 messages" in findings(report, "odd")
    (tmp_path / "street.txt").write_text(kitti_rows(curve(1)))
    with pytest.raises(DamagedFileError, match="1 poses for the first 2 scans"):
        rosbag(tmp_path, max_frames=2).sequence("street")
    (tmp_path / "street.txt").unlink()
    write_bag(tmp_path, "nothing", {"/points": [clouds[1]]})
    with pytest.raises(DamagedFileError, match="no message of /points has points"):
        rosbag(tmp_path).sequence("nothing")


def test_cloud_without_xyz_fields_is_refused(tmp_path):
    write_bag(tmp_path, "street", {"/points": [np.zeros(5, [("range", "<f4"), ("x", "<f4")])]})
    with pytest.raises(DamagedFileError, match="no fields x, y and z, only range, x"):
        rosbag(tmp_path).sequence("street").scan(0)
    assert not rosbag(tmp_path).check().usable


@pytest.mark.parametrize("empty", [(0, 1), (2, 3), (1, 2, 3, 4)], ids=str)
def test_scans_without_returns_are_empty(tmp_path, caplog, empty):
    clouds = [as_rows(random_points(i) * (i not in empty), OUSTER, t=TIMES_NS) for i in range(5)]
    write_bag(tmp_path, "street", {"/points": clouds})
    data = rosbag(tmp_path, deskew=True)
    assert data.check().usable
    sequence = data.sequences(["street"])["street"]
    assert [i for i, scan in enumerate(sequence) if not len(scan.points)] == list(empty)
    assert np.allclose(sequence.timestamps, 1.6e9 + 0.0495 + 0.1 * np.arange(5), rtol=0, atol=1e-6)
    caplog.clear()
    sequence = rosbag(tmp_path).sequence("street")
    assert len(list(sequence)) == 5 and caplog.text.count("not a single return") == 1
    maps = cached_vertex_maps(sequence, SphericalProjection(), tmp_path)
    assert [bool(maps[i].any()) for i in range(5)] == [i not in empty for i in range(5)]


def test_sequence_without_any_return_is_refused(tmp_path):
    write_bag(tmp_path, "street", {"/points": [as_rows(np.full((5, 3), np.nan), PLAIN)] * 3})
    with pytest.raises(UserError, match=r"street: none of its 3 scans has a single return(.|\n)*data\.test_sequences"):
        rosbag(tmp_path).sequences(["street"])


def cut_half(path):
    path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])


def cut_end(path):
    path.write_bytes(path.read_bytes()[:-5000])


def overwrite_middle(path):
    data = bytearray(path.read_bytes())
    data[4096:-4096] = b"\xff" * (len(data) - 8192)
    path.write_bytes(data)


def replace_by_text(path):
    path.write_text("this is no bag\n" * 20)


def empty(path):
    path.write_bytes(b"")


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("damage", [cut_half, cut_end, overwrite_middle, replace_by_text, empty])
def test_damaged_bag_is_reported(tmp_path, kind, damage):
    path = write_bag(tmp_path, "street", {"/points": plain_clouds(40)}, kind)
    (storage,) = [path] if kind == "ros1" else [p for p in path.iterdir() if p.name != "metadata.yaml"]
    damage(storage)
    with pytest.raises(UserError, match="cannot be read as a ROS bag"):
        list(rosbag(tmp_path).sequence("street"))
    assert "street" in findings(rosbag(tmp_path).full_check(), "missing")


@pytest.mark.parametrize("content", ["", "rosbag2_bagfile_information: 7\n", "{", "a: b\n"])
def test_damaged_metadata_is_reported(tmp_path, content):
    path = write_bag(tmp_path, "street", {"/points": plain_clouds()}, "sqlite3")
    (path / "metadata.yaml").write_text(content)
    with pytest.raises(DamagedFileError, match="cannot be read as a ROS bag"):
        rosbag(tmp_path).sequence("street")
    (path / "metadata.yaml").unlink()
    assert len(rosbag(tmp_path).sequence("street")) == 3


def test_database_without_message_definitions_is_read(tmp_path):
    path = write_bag(tmp_path, "street", {"/points": plain_clouds()}, "sqlite3")
    (path / "metadata.yaml").unlink()
    with closing(sqlite3.connect(path / "street.db3")) as connection:
        connection.execute("DROP TABLE schema")
        connection.execute("DROP TABLE message_definitions")
        connection.execute("ALTER TABLE topics DROP COLUMN type_description_hash")
        connection.commit()
    assert [len(scan.points) for scan in rosbag(tmp_path).sequence("street")] == [200] * 3


@pytest.mark.parametrize("folder", ["run #1", "what? yes", "50%25"])
def test_error_names_special_characters_in_path(tmp_path, folder):
    write_bag(tmp_path, "street", {"/points": plain_clouds()}, "sqlite3")
    (tmp_path / "street").rename(tmp_path / folder)
    with pytest.raises(DamagedFileError, match=r"change: the names in its path that hold #, \? or %"):
        rosbag(tmp_path).sequence(folder)


@pytest.mark.parametrize("suffix", ["DB3", "MCAP"])
def test_error_for_uppercase_suffix_asks_to_rename(tmp_path, suffix):
    path = write_bag(tmp_path, "street", {"/points": plain_clouds()}, {"DB3": "sqlite3", "MCAP": "mcap"}[suffix])
    (path / f"street.{suffix.lower()}").rename(tmp_path / f"S.{suffix}")
    with pytest.raises(DamagedFileError, match=r"S\.(.|\n)*a suffix in small letters"):
        rosbag(tmp_path / f"S.{suffix}").sequence("S")


def test_error_for_ros1_mcap_asks_for_original_bag(tmp_path):
    file = write_bag(tmp_path, "street", {"/points": plain_clouds()}, "mcap") / "street.mcap"
    file.write_bytes(file.read_bytes().replace(b"ros2", b"ros1", 1))  # the header's profile
    with pytest.raises(DamagedFileError, match=r"change: data\.root to the \.bag from which it was converted"):
        rosbag(tmp_path).sequence("street")


def test_missing_storage_file_is_reported(tmp_path):
    path = write_bag(tmp_path, "street", {"/points": plain_clouds()}, "mcap")
    (path / "street.mcap").unlink()
    assert "missing" in findings(rosbag(tmp_path).check(), "missing")
    with pytest.raises(DamagedFileError, match="missing"):
        rosbag(tmp_path).sequence("street")


@pytest.mark.parametrize("kind", KINDS)
def test_messages_with_equal_recording_time_are_all_read(tmp_path, kind, monkeypatch):
    monkeypatch.setattr("tests.data.writers.RECORDED_EVERY_NS", 0)
    write_bag(tmp_path, "street", {"/points": plain_clouds(3)}, kind)
    sequence = rosbag(tmp_path).sequence("street")
    assert len({scan.points.numpy().tobytes() for scan in sequence}) == 3


def test_deskewing_requires_point_times(tmp_path):
    write_bag(tmp_path, "without", {"/points": plain_clouds(1)})
    write_bag(tmp_path, "with", {"/points": [as_rows(random_points(0), OUSTER, t=TIMES_NS)]})
    data = rosbag(tmp_path, deskew=True)
    write_bag(tmp_path, "zero", {"/points": [as_rows(random_points(0), OUSTER, t=0)] * 2})
    assert len(data.sequence("with")) == 1
    for name in ("without", "zero"):
        with pytest.raises(UserError, match=r"data\.deskew=false"):
            data.sequence(name)
    assert "no point times" in findings(data.check(), "missing")


def test_beam_correction_raises_points(tmp_path):
    write_bag(tmp_path, "street", {"/points": plain_clouds(1)})
    points, raised = (rosbag(tmp_path, beam_correction_deg=d).sequence("street").scan(0).points for d in (0.0, 1.0))
    assert torch.allclose(points.norm(dim=1), raised.norm(dim=1)) and (raised[:, 2] > points[:, 2]).all()


def test_fingerprint_depends_on_settings_and_clouds_only(tmp_path):
    for folder, first in (("a", 0), ("b", 0), ("c", 1)):
        write_bag(tmp_path / folder, "street", {"/points": plain_clouds(first=first)})

    def fingerprint(folder, **settings):
        return rosbag(tmp_path / folder, **settings).sequence("street").fingerprint

    assert fingerprint("a") == fingerprint("b")
    changed = fingerprint("c"), fingerprint("a", beam_correction_deg=1), fingerprint("a", max_frames=2)
    assert len({fingerprint("a"), *changed}) == 4


def send_first_x(sequence, order, pipe):
    torch.set_num_threads(1)  # as in a worker of a DataLoader: a forked process has no other threads to wait for
    pipe.send([first_x(sequence, i) for i in order])


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.filterwarnings("ignore:.*fork:DeprecationWarning")
def test_forked_processes_read_same_sequence(tmp_path, kind):
    """A forked process inherits an open bag, and must not move its parent's position in the file."""
    large = [as_rows(random_points(i, 30_000), OUSTER) for i in range(5)]  # each fills a chunk of the file
    write_bag(tmp_path, "street", {"/points": large}, kind)
    sequence = rosbag(tmp_path).sequence("street")
    order = 3 * list(range(5))
    expected = [first_x(sequence, i) for i in order]
    context = get_context("fork")
    here, there = context.Pipe()
    children = [context.Process(target=send_first_x, args=(sequence, order, there)) for _ in range(2)]
    for child in children:
        child.start()
    assert [first_x(sequence, i) for i in order] == expected
    for child in children:
        child.join()
        assert child.exitcode == 0
    assert [here.recv() for _ in children] == [expected] * 2
    assert [first_x(pickle.loads(pickle.dumps(sequence)), i) for i in range(5)] == expected[:5]


def test_missing_rosbags_package_is_reported(tmp_path, monkeypatch):
    write_bag(tmp_path, "street", {"/points": plain_clouds(1)})
    monkeypatch.setitem(sys.modules, "rosbags", None)
    with pytest.raises(UserError, match=r"pip install 'lidarlearn\[rosbag\]'"):
        rosbag(tmp_path).sequence("street")
    assert "package rosbags" in findings(rosbag(tmp_path).check(), "missing")


@pytest.fixture(scope="module")
def os1_bag(tmp_path_factory):
    """An OS1-64 on a turning car, in its driver's layout and stamped at the first point; with ground truth."""
    root, frames = tmp_path_factory.mktemp("os1"), 6
    path = scenes.straight_path(frames + 2, 0.9, yaw_step=0.02)
    drive = Drive(scenes.street(), poses=path, frames=frames, sensor=os1_64(512), motion_distortion=True)
    clouds = [as_rows(scan.points.numpy(), OUSTER, t=1e8 * (scan.times.numpy() + 0.5)) for scan in drive]
    write_bag(root, "street", {"/os_cloud_node/points": clouds}, stamps=drive.timestamps.numpy() - 0.05)
    (root / "street.tum").write_text(tum_rows(drive.T_world_lidar.numpy(), drive.timestamps.numpy()))
    return root


def test_odometry_recovers_motion_from_bag(os1_bag):
    sequence = rosbag(os1_bag, deskew=True).sequence("street")
    odometry = build("cv+kd_f2m", projection="os1_64")
    frames = [odometry.register_scan(scan.points, scan.times) for scan in sequence]
    translation_m, rotation_deg = motion_errors(poses(frames), sequence.T_world_lidar)
    assert translation_m.max() < 0.02 and rotation_deg.max() < 0.2


@pytest.mark.slow
def test_evaluate_scores_odometry_on_bag(os1_bag, tmp_path, monkeypatch):
    monkeypatch.setattr(evaluate, "figures", lambda *_: iter(()))  # drawing takes longer than everything else
    settings = ["data=rosbag", f"data.root={os1_bag}", "data.deskew=true", "projection@data.projection=os1_64"]
    monkeypatch.setattr(sys, "argv", ["x", "methods=[cv+kd_f2m]", "device=cpu", f"hydra.run.dir={tmp_path}", *settings])
    evaluate.main()
    (row,) = json.loads((tmp_path / "results.json").read_text())["results"]
    assert (row["sequence"], row["frames"]) == ("street", 6)
    assert row["rpe_translation_m"] < 0.02 and row["rpe_rotation_deg"] < 0.2
