"""Odometries of other projects behind the interface of `BaseOdometry`."""

import sys

import pytest
import torch

from lidarlearn.errors import UserError
from lidarlearn.geometry import se3
from lidarlearn.simulation.drive import Drive
from lidarlearn.simulation.sensors import hdl64
from tests import scenes
from tests.odometry.odometries import build, motion_errors, poses

PACKAGES = {"kiss_icp": "kiss-icp", "small_gicp": "small_gicp"}
BASELINES = tuple(PACKAGES)


@pytest.fixture(scope="module")
def drive() -> Drive:
    return Drive(scenes.street(), poses=scenes.straight_path(9, 0.6), frames=9, sensor=hdl64(256))


@pytest.mark.parametrize("name", BASELINES)
def test_baseline_follows_drive(name, drive):
    pytest.importorskip(name)
    odometry = build(name)
    frames = [odometry.register_scan(scan.points) for scan in drive]
    assert torch.equal(frames[0].T_world_lidar, se3.identity())
    assert [frame.health.frame for frame in frames] == list(range(9))
    assert {frame.health.initialization for frame in frames} == {name}
    translations, angles = motion_errors(poses(frames), drive.T_world_lidar)
    assert translations.median() < 0.1 and angles.max() < 1.0


@pytest.mark.parametrize("name", BASELINES)
def test_baseline_instances_share_no_state(name, drive):
    pytest.importorskip(name)
    first = build(name)
    first.register_scan(drive.scan(0).points)
    first.register_scan(drive.scan(1).points)
    assert torch.equal(build(name).register_scan(drive.scan(3).points).T_world_lidar, se3.identity())


def test_kiss_icp_uses_point_times(drive):
    pytest.importorskip("kiss_icp")
    with_times, without = build("kiss_icp"), build("kiss_icp")
    for index in range(4):
        points = drive.scan(index).points
        times = -torch.atan2(points[:, 1], points[:, 0]) / (2 * torch.pi)
        skewed, plain = with_times.register_scan(points, times), without.register_scan(points)
    assert not torch.allclose(skewed.T_world_lidar, plain.T_world_lidar, atol=1e-3)


@pytest.mark.parametrize("name", BASELINES)
def test_missing_package_error_names_pip_install(name, monkeypatch):
    monkeypatch.setitem(sys.modules, name, None)
    with pytest.raises(Exception, match=f"pip install {PACKAGES[name]}") as raised:
        build(name)
    assert isinstance(raised.value.__cause__ or raised.value, UserError)
