"""Simulated drives, exported in each native format and read back by its reader."""

import shlex
import subprocess
from dataclasses import replace
from functools import cache, cached_property

import numpy as np
import pytest
import torch

from lidarlearn.commands.data import compose_data_set, data_groups, main, matched_names
from lidarlearn.data.export.formats import exporter_of
from lidarlearn.data.sequence import Scan, Sequence
from lidarlearn.errors import UserError
from lidarlearn.geometry import se3
from lidarlearn.simulation.drive import Drive
from lidarlearn.simulation.sensors import Sensor, hdl32_inverted, hdl64
from tests import scenes
from tests.data.datasets import data_set
from tests.data.writers import curve, kitti_rows, random_points, write_float32
from tests.odometry.odometries import build, motion_errors, poses

FRAMES = 3
SMALL = hdl64(64)
OS1_GEN1 = Sensor("OS1-64", tuple(torch.linspace(16.6, -16.6, 64).tolist()), 1024, range_noise=0.02)
# format, sequence there, sensor, distorted by motion, largest error of a coordinate [m]
FORMATS = {
    "kitti_00-08": ("03", hdl64(512), False, 2e-5),
    "kitti_raw": ("2011_09_26_drive_0009", hdl64(512), True, 2e-5),
    "kitti_360": ("0003", hdl64(512), True, 1e-6),
    "ford_campus": ("IJRR-Dataset-1", hdl64(512), False, 1e-6),
    "nclt": ("2012-01-08", hdl32_inverted(512), False, 0.003),
    "newer_college": ("01_short_experiment", OS1_GEN1, True, 1e-6),
    "folder": ("drive", hdl64(512), True, 1e-6),
}
TIME_TOLERANCE = 3e-3  # of a sweep: azimuths shift by a fraction of a column from scan to scan


class KeptDrive(Drive):
    """A drive that simulates its scans once for all tests."""

    @cached_property
    def scans(self):
        return [super(KeptDrive, self).scan(index) for index in range(len(self))]

    def scan(self, index):
        return self.scans[index]


@cache
def simulated(sensor, distorted, frames=FRAMES):
    """A slight turn at 9 m/s."""
    path = scenes.straight_path(frames + 2, 0.9, yaw_step=0.02)
    return KeptDrive(scenes.street(), poses=path, frames=frames, sensor=sensor, motion_distortion=distorted)


def export(drive, target, name, suffix=None):
    exporter_of(target, suffix).export(drive, name)


def sorted_by_position(points, *others):
    """Points and their attributes in an order that does not depend on that in the file."""
    order = torch.from_numpy(np.lexsort(points.numpy().T))
    return [points[order], *(other[order] for other in others)]


@pytest.mark.parametrize("name", FORMATS)
def test_round_trip(name, tmp_path):
    sequence, sensor, distorted, tolerance = FORMATS[name]
    drive = simulated(sensor, distorted)
    target = data_set(name, tmp_path)
    export(drive, target, sequence)
    read = data_set(name, tmp_path).sequence(sequence)
    assert len(read) == FRAMES
    for scan, original in zip(read, drive, strict=True):
        points, times = original.points, original.times
        if name == "ford_campus":
            points = points[points.norm(dim=1) >= 8.0]
        assert len(scan.points) == len(points)
        if name == "newer_college":  # column after column
            points, times = sorted_by_position(points, times)
            got, got_times = sorted_by_position(scan.points, scan.times)
        else:
            got, got_times = scan.points, scan.times
        assert (got - points).abs().max() <= tolerance
        assert (got_times is None) == (times is None)
        assert times is None or (got_times - times).abs().max() <= TIME_TOLERANCE
    torch.testing.assert_close(read.T_world_lidar, drive.T_world_lidar, rtol=0, atol=1e-4)
    torch.testing.assert_close(
        read.timestamps - read.timestamps[0], drive.timestamps - drive.timestamps[0], rtol=0, atol=1e-6
    )


class Recorded(Sequence):
    """Scans with intensities, and poses in the frame of a camera."""

    name, reference_frame = "drive", "camera"
    T_reference_lidar = se3.from_euler(torch.tensor([0.1, -0.2, 0.3, 1.5, 0.1, -1.4], dtype=torch.float64))
    T_world_lidar = torch.from_numpy(curve(3))
    fingerprint = ""

    def __len__(self):
        return 3

    def scan(self, index):
        return Scan(torch.from_numpy(random_points(index)), intensities=torch.linspace(0, 1, 200))


@pytest.mark.parametrize(
    ("name", "sequence", "setting"),
    [("kitti_00-08", "03", {}), ("nclt", "2012-01-08", {}), ("folder", "drive", {"max_intensity": 200}),
     ("ford_campus", "IJRR-Dataset-1", {"T_vehicle_lidar_m_deg": [2.4, -0.01, -2.3, 180, 0, 10]})],
    ids=["kitti", "nclt", "folder", "ford_campus"],
)  # fmt: skip
def test_export_preserves_intensities_and_extrinsics(name, sequence, setting, tmp_path):
    drive, target = Recorded(), data_set(name, tmp_path, **setting)
    export(drive, target, sequence)
    read = target.sequence(sequence)
    torch.testing.assert_close(read.T_world_lidar, drive.T_world_lidar, rtol=0, atol=1e-6)
    if read.reference_frame == "camera":
        torch.testing.assert_close(read.T_reference_lidar, drive.T_reference_lidar)
    if name != "ford_campus":  # no intensities in its files
        torch.testing.assert_close(read.scan(1).intensities, drive.scan(1).intensities, rtol=0, atol=0.5 / 255)


@pytest.mark.parametrize("name", ["kitti_00-08", "folder"])
def test_export_keeps_fractions_of_unix_times(name, tmp_path):
    write_folder(tmp_path / "scans", names=("a",), scans=3)
    (tmp_path / "scans" / "a" / "times.txt").write_text("1700000000.05\n1700000000.15\n1700000000.25\n")
    drive = data_set("folder", tmp_path / "scans").sequence("a")
    export(drive, data_set(name, tmp_path / "copy"), "03")
    read = data_set(name, tmp_path / "copy").sequence("03")
    torch.testing.assert_close(read.timestamps, drive.timestamps, rtol=0, atol=1e-6)


@pytest.mark.slow
@pytest.mark.parametrize("name", FORMATS)
def test_odometry_error_is_equal_on_exported_drive(name, tmp_path):
    sequence, sensor, distorted, _ = FORMATS[name]
    drive = simulated(sensor, distorted, frames=15)
    target = data_set(name, tmp_path)
    export(drive, target, sequence)
    read = data_set(name, tmp_path).sequence(sequence)
    errors = []
    for source in (drive, read):
        odometry = build("cv+kd_f2m")
        frames = [odometry.register_scan(scan.points, scan.times) for scan in source]
        errors.append(float(motion_errors(poses(frames), drive.T_world_lidar)[0].mean()))
    assert errors[0] < 0.02
    # Ford Campus leaves out what is close to the car, NCLT rounds to 5 mm.
    assert errors[1] == pytest.approx(errors[0], abs={"ford_campus": 0.005, "nclt": 0.003}.get(name, 0.001))


@pytest.mark.parametrize("suffix", [".bin", ".npy", ".pcd", ".ply"])
def test_folder_export_in_each_file_format(suffix, tmp_path):
    timed = suffix in (".pcd", ".ply")
    drive = simulated(SMALL, timed)
    export(drive, data_set("folder", tmp_path), "drive", suffix=suffix)
    read = data_set("folder", tmp_path).sequence("drive")
    assert torch.equal(read.scan(1).points, drive.scan(1).points)
    assert (read.scan(1).times is not None) == timed


@pytest.mark.parametrize("suffix", [".bin", ".npy"])
def test_export_refuses_format_without_point_times(suffix, tmp_path):
    with pytest.raises(UserError, match=rf"suffix=\{suffix}: (.|\n)*suffix=\.pcd or suffix=\.ply"):
        export(simulated(SMALL, True), data_set("folder", tmp_path), "drive", suffix=suffix)
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(
    "chosen", [(), ("projection@to.projection=vlp16",), ("to.projection.fov_up_deg=20.5",)], ids=str
)
def test_printed_command_selects_projection_of_sensor(chosen, tmp_path, capsys):
    write_folder(tmp_path / "scans")
    source = ("data=folder", f"data.root={tmp_path}/scans", "projection@data.projection=hdl32_inverted")
    assert run(*source, "to=kitti_00-08", f"to.root={tmp_path}/kitti", *chosen) == 0
    words = shlex.split(capsys.readouterr().out.split("train.py ")[1])
    given = [word.replace("to.", "data.", 1) for word in chosen]
    expected = compose_data_set(["data=kitti_00-08", *given] if chosen else source)
    assert compose_data_set(words).projection == expected.projection


def test_printed_command_includes_config_dir(tmp_path, capsys):
    (tmp_path / "my configs" / "data").mkdir(parents=True)
    for name, default in (("mine", "folder"), ("theirs", "kitti_00-08")):
        text = f"defaults:\n  - {default}\n  - override /projection@projection: vlp16\n"
        (tmp_path / "my configs" / "data" / f"{name}.yaml").write_text(text)
    write_folder(tmp_path / "scans")
    flag, folder = "--config-dir", str(tmp_path / "my configs")
    source, target = ("data=mine", f"data.root={tmp_path}/scans"), ("to=theirs", f"to.root={tmp_path}/kitti")
    assert run(*source, flag, folder, *target) == 0
    words = shlex.split(capsys.readouterr().out.split("train.py ")[1])
    assert words[:3] == [flag, folder, "data=theirs"]
    data = compose_data_set(words[2:], folder)
    assert data.projection.height == 16 and [len(data.sequence(name)) for name in data.names] == [2, 2]


@pytest.mark.parametrize("period", [0.1, 0.05])
def test_folder_export_keeps_point_times_at_any_scan_rate(period, tmp_path):
    drive = simulated(replace(hdl64(128), period=period), True, frames=3)
    export(drive, data_set("folder", tmp_path), "drive")
    times, read = drive.scan(1).times, data_set("folder", tmp_path).sequence("drive").scan(1).times
    assert (read - times).abs().max() < 5e-3  # half a column: the middle is that of the columns that returned


@pytest.mark.parametrize("name", ["kitti_00-08", "folder"])
def test_empty_scan_keeps_its_index(name, tmp_path):
    write_folder(tmp_path / "scans", names=("a",), scans=3)
    write_float32(tmp_path / "scans" / "a" / "0.bin", np.zeros((5, 3)))
    export(data_set("folder", tmp_path / "scans").sequence("a"), data_set(name, tmp_path / "copy"), "03")
    read = data_set(name, tmp_path / "copy").sequence("03")
    assert [len(scan.points[(scan.points != 0).any(dim=1)]) for scan in read] == [0, 200, 200]


def write_folder(root, names=("a", "b"), scans=2):
    for name in names:
        for i in range(scans):
            write_float32(root / name / f"{i}.bin", random_points(i))


def contents(root):
    return {path: path.read_bytes() for path in root.rglob("*") if path.is_file()}


def run(*arguments):
    with pytest.raises(SystemExit) as exited:
        main(["export", *arguments])
    return exited.value.code


def test_export_writes_once_and_quotes_printed_command(tmp_path, capsys):
    write_folder(tmp_path / "scans of mine")
    root = tmp_path / "kitti of mine"
    assert run("data=folder", f"data.root='{tmp_path}/scans of mine'", "to=kitti_00-08", f"to.root='{root}'") == 0
    printed = capsys.readouterr().out
    assert printed.count("writing sequence") == printed.count(" -> ") == 2
    words = subprocess.run(["bash", "-c", f"printf '%s\\n' {printed.split('train.py ')[1]}"], stdout=subprocess.PIPE)
    data = compose_data_set(words.stdout.decode().splitlines())
    assert data.root == root and len(data.names) == 2
    assert data.train_sequences == data.val_sequences == data.test_sequences
    assert [len(data.sequence(name)) for name in data.train_sequences] == [2, 2]


@pytest.mark.parametrize("name", FORMATS)
def test_export_refuses_existing_sequence(name, tmp_path):
    sequence, sensor, distorted, _ = FORMATS[name]
    target = data_set(name, tmp_path)
    export(simulated(replace(sensor, columns=64), distorted, frames=2), target, sequence)
    before = contents(tmp_path)
    with pytest.raises(UserError, match=r"is there already(.|\n)*to\.root"):
        export(simulated(sensor, distorted), target, sequence)
    assert contents(tmp_path) == before


def test_export_refuses_existing_pose_file(tmp_path, capsys):
    write_folder(tmp_path / "scans")
    poses = tmp_path / "kitti" / "poses" / "01.txt"
    poses.parent.mkdir(parents=True)
    poses.write_text("of someone else\n")
    (tmp_path / "kitti" / "sequences").mkdir()
    to = ("to=kitti_00-08", f"to.root={tmp_path}/kitti", "to.train_sequences=['00','01']")
    assert run("data=folder", f"data.root={tmp_path}/scans", *to, "to.val_sequences=[]", "to.test_sequences=[]") == 1
    assert f"{poses} is there already" in capsys.readouterr().err
    assert list(contents(tmp_path / "kitti")) == [poses]


def test_export_refuses_to_change_shared_calibration(tmp_path):
    drive, target = simulated(SMALL, True), data_set("kitti_raw", tmp_path)
    export(drive, target, "2011_09_26_drive_0009")
    export(drive, target, "2011_09_26_drive_0010")  # the same calibration
    calibration = tmp_path / "2011_09_26" / "calib_imu_to_velo.txt"
    calibration.write_text("R: of the genuine data set\n")
    with pytest.raises(UserError, match=r"calib_imu_to_velo\.txt belongs to other sequences"):
        export(drive, target, "2011_09_26_drive_0011")
    assert calibration.read_text().endswith("genuine data set\n")
    assert len(list(tmp_path.glob("*/*_sync"))) == 2


def test_matched_names_keep_splits_disjoint():
    source = data_set("simulated_urban", "x")
    target = data_set("kitti_00-08", "y")
    names = matched_names(source, target)
    assert names["urban_06"] == "07" and names["urban_07"] == "09"
    assert [names.get(name) for name in source.train_sequences[:9]] == [*(f"0{i}" for i in range(7)), "08", None]
    assert len(set(names.values())) == len(names) == 10


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (("to=simulated_urban", "to.root=x"), "kitti_00-08|"),
        (("to=kitti_00-08", "to.root=x", "suffix=.ply"), "to=folder"),
        (("to=folder", "to.root=x", "suffix=.las"), "suffix=.bin|.npy|.pcd|.ply"),
    ],
    ids=["target", "suffix of other target", "suffix"],
)
def test_export_command_refuses_target_or_suffix(arguments, message, tmp_path, capsys, monkeypatch):
    monkeypatch.chdir(tmp_path)
    write_folder(tmp_path / "scans")
    assert run("data=folder", f"data.root={tmp_path}/scans", *arguments) == 1
    assert message in capsys.readouterr().err and not (tmp_path / "x").exists()


def test_export_advice_names_existing_data_groups():
    with pytest.raises(UserError) as error:
        exporter_of(data_set("simulated_urban", "x"))
    options = str(error.value).split("to=")[1].split("|")
    assert len(options) == 7 and set(options) <= set(data_groups())


def test_oxts_packets_hold_forward_speed(tmp_path):
    drive = simulated(SMALL, True)
    export(drive, data_set("kitti_raw", tmp_path), "2011_09_26_drive_0009")
    folder = tmp_path / "2011_09_26" / "2011_09_26_drive_0009_sync" / "oxts" / "data"
    packets = [[float(v) for v in path.read_text().split()] for path in sorted(folder.iterdir())]
    assert len(packets) == FRAMES and all(len(packet) == 30 for packet in packets)
    assert [packet[8] for packet in packets] == pytest.approx([9.0] * FRAMES, abs=0.2)  # forward [m/s]


@pytest.mark.parametrize(
    ("name", "distorted", "message"),
    [
        ("kitti_00-08", True, "motion_distortion=false"),
        ("nclt", True, "motion_distortion=false"),
        ("ford_campus", True, "motion_distortion=false"),
        ("kitti_raw", False, "motion_distortion=true"),
        ("kitti_360", False, "motion_distortion=true"),
        ("newer_college", False, "motion_distortion=true"),
        ("simulated_urban", False, "cannot be written"),
    ],
)
def test_export_refuses_drive_unfit_for_format(name, distorted, message, tmp_path):
    with pytest.raises(UserError, match=message):
        export(simulated(SMALL, distorted), data_set(name, tmp_path), "2012-01-08_drive_1")


def test_export_checks_all_drives_before_writing(tmp_path, capsys):
    write_folder(tmp_path / "scans")
    (tmp_path / "scans" / "a" / "poses.txt").write_text(kitti_rows(curve(2)))  # but none for b
    to = ("to=ford_campus", f"to.root={tmp_path}/ford", "to.train_sequences=[IJRR-Dataset-1,IJRR-Dataset-2]")
    source = ("data=folder", f"data.root={tmp_path}/scans", "data.val_sequences=[]", "data.test_sequences=[]")
    assert run(*source, *to) == 1
    assert "b has no ground truth" in capsys.readouterr().err and not (tmp_path / "ford").exists()
    (tmp_path / "scans" / "b" / "poses.txt").write_text(kitti_rows(curve(2)))
    assert run(*source, *to) == 0


@pytest.mark.parametrize(("name", "message"), [("nclt", "date"), ("kitti_raw", "name a drive")])
def test_export_refuses_invalid_sequence_name(name, message, tmp_path):
    with pytest.raises(UserError, match=message):
        export(simulated(SMALL, name == "kitti_raw"), data_set(name, tmp_path), "day")
    assert not list(tmp_path.iterdir())


@pytest.mark.slow
def test_export_command_writes_all_sequences(tmp_path, capsys):
    arguments = [
        "export",
        "data=simulated_urban",
        f"data.root={tmp_path}/simulated",
        "data.frames=2",
        "data.sensor.columns=64",
        "data.train_sequences=[urban_00,urban_01]",
        "to=kitti_00-08",
        f"to.root={tmp_path}/kitti",
    ]
    with pytest.raises(SystemExit) as exited:
        main(arguments)
    printed = capsys.readouterr().out
    assert exited.value.code == 0
    assert "urban_06 -> 07: 2 scans" in printed and "urban_07 -> 09" in printed
    suggested = shlex.split(printed.split("train.py ")[1])
    data = compose_data_set(suggested)
    assert len(data.train_sequences) == 2 and data.check().usable
    assert "" not in suggested and not {*data.train_sequences} & {*data.val_sequences, *data.test_sequences}
    assert torch.equal(data.sequence("09").T_world_lidar[0], se3.identity())
