import logging
from dataclasses import replace

import pytest
import torch
from rich.console import Console

from lidarlearn.commands import data as command
from lidarlearn.data.datamodule import OdometryDataModule
from lidarlearn.data.kitti import KittiOdometry
from lidarlearn.data.sequence import Scan
from lidarlearn.errors import UserError
from tests.box_world import SMALL, BoxDrives, BoxSequence
from tests.data.datasets import findings
from tests.data.writers import write_kitti_odometry

FRAMES = 6
POSES = torch.eye(4, dtype=torch.float64).repeat(FRAMES, 1, 1)
LOST = POSES.clone()
LOST[2, 0, 3], LOST[4, 1, 1] = torch.nan, torch.inf
POINTS = torch.rand(50, 3) + 1

DOUBLE_4X4, SINGLE_3 = "not a float64 tensor of (6, 4, 4)", "not a float32 tensor of (n, 3)"

INVALID = {
    "poses in single precision": ("T_world_lidar", POSES.float(), f"is a float32 tensor of (6, 4, 4), {DOUBLE_4X4}"),
    "poses of numpy": ("T_world_lidar", POSES.numpy(), f"is a float64 numpy.ndarray of (6, 4, 4), {DOUBLE_4X4}"),
    "poses in a list": ("T_world_lidar", POSES.tolist(), f"is a list, {DOUBLE_4X4}"),
    "too few poses": ("T_world_lidar", POSES[:4], f"is a float64 tensor of (4, 4, 4), {DOUBLE_4X4}"),
    "no matrices": ("T_world_lidar", POSES[:, :3], f"is a float64 tensor of (6, 3, 4), {DOUBLE_4X4}"),
    "unknown poses": ("T_world_lidar", LOST, "not finite in 2 of its 6 poses, first in that of scan 2"),
    "too few timestamps": ("timestamps", torch.zeros(5), "timestamps is a float32 tensor of (5), not a tensor of (6)"),
    "timestamps in a list": ("timestamps", [0.1] * FRAMES, "timestamps is a list, not a tensor of (6)"),
    "unknown timestamps": ("timestamps", LOST[:, 0, 3], "not finite in 1 of its 6 times, first in that of scan 2"),
    "points in double precision": ("points", POINTS.double(), f"is a float64 tensor of (50, 3), {SINGLE_3}"),
    "points of numpy": ("points", POINTS.numpy(), f"is a float32 numpy.ndarray of (50, 3), {SINGLE_3}"),
    "four columns": ("points", torch.ones(50, 4), f"is a float32 tensor of (50, 4), {SINGLE_3}"),
    "too few point times": ("times", torch.zeros(49), "times is a float32 tensor of (49), not a tensor of (50)"),
}


class CustomSequence(BoxSequence):
    """A sequence of a user's reader, with an attribute replaced."""

    def __init__(self, name, frames, attribute, value):
        super().__init__(name, FRAMES)
        self._poses = self._poses[:frames]
        self.first = Scan(POINTS)
        if attribute in ("points", "times"):
            object.__setattr__(self.first, attribute, value)  # bypasses the type checks, which only tests have
        elif attribute is not None:
            setattr(self, attribute, value)

    def scan(self, index):
        return self.first


class CustomDrives(BoxDrives):
    """Drives of which sequence "1" has an invalid attribute; `check` does not report it."""

    def __init__(self, attribute=None, value=None, frames=FRAMES):
        super().__init__(frames)
        self.invalid = (attribute, value)

    def sequence(self, name):
        return CustomSequence(name, self.frames, *(self.invalid if name == "1" else (None, None)))


@pytest.mark.parametrize("case", INVALID)
def test_sequences_refuse_invalid_values_of_reader(case):
    attribute, value, message = INVALID[case]
    with pytest.raises(UserError) as error:
        CustomDrives(attribute, value).sequences(["0", "1"])
    text = str(error.value)
    assert text.startswith("1: ") and message in text and "change: its reader" in text


@pytest.mark.parametrize(
    ("attribute", "value"),
    [
        (None, None),
        ("T_world_lidar", None),
        ("timestamps", None),
        ("timestamps", torch.arange(FRAMES)),
        ("times", torch.zeros(50)),
    ],
)
def test_optional_values_may_be_absent_or_of_any_type(attribute, value):
    data = CustomDrives(attribute, value)
    assert len(data.sequences(["0", "1"])) == 2 and data.full_check().usable


@pytest.mark.parametrize("case", INVALID)
def test_check_command_reports_invalid_values_of_reader(case, monkeypatch, capsys):
    attribute, value, message = INVALID[case]
    monkeypatch.setattr(command, "compose_data_set", lambda *_: CustomDrives(attribute, value))
    assert CustomDrives(attribute, value).check().usable
    assert not command.check([], Console(soft_wrap=True))
    printed = capsys.readouterr().out
    assert message in printed and "NOT usable" in printed and printed.count("missing ") == 1


def test_full_check_reports_sequence_without_scans():
    missing = findings(CustomDrives(frames=0).full_check(), "missing").split(" | ")
    assert len(missing) == 3 and "none of its 0 scans has a single return" in missing[0]


def test_full_check_and_sequences_warn_of_field_of_view(caplog):
    data = CustomDrives()
    data.projection = replace(SMALL, fov_up_deg=2.0, fov_down_deg=-2.0)
    report = data.full_check()
    assert report.usable and "lie outside the image" in report.findings[0].detail
    with caplog.at_level(logging.WARNING):
        data.sequences(["0"])
    assert "lie outside the image" in caplog.text


def test_datamodule_refuses_poses_that_are_not_finite(tmp_path):
    datamodule = OdometryDataModule(CustomDrives("T_world_lidar", LOST), cache_root=str(tmp_path))
    with pytest.raises(UserError, match="first in that of scan 2"):
        datamodule.prepare_data()
    assert not list(tmp_path.iterdir())


def test_full_check_opens_each_sequence_once(tmp_path, monkeypatch):
    write_kitti_odometry(tmp_path)
    opened = []
    data = KittiOdometry(tmp_path, SMALL, ["04"], ["04"], ["04"], None, False, 0.0)
    sequence = data.sequence
    monkeypatch.setattr(data, "sequence", lambda name: (opened.append(name), sequence(name))[1])
    assert data.full_check().usable and opened == ["04"]
