"""What a GPU is asked for by recordings gives the poses that the CPU gives without."""

import pytest
import torch

from lidarlearn.geometry import se3
from lidarlearn.geometry.projection import SphericalProjection
from lidarlearn.models.posenet import PoseNet
from lidarlearn.odometry.initialization.posenet import PoseNetInitialization
from lidarlearn.odometry.scan_by_scan import InitializationAlone, ScanByScan
from lidarlearn.registration.association import point_buffer
from lidarlearn.training.trained_network import TrainedNetwork
from tests import pretended_graphs
from tests.gpu import on_gpu
from tests.odometry.odometries import build, motion_errors, poses, run, scans, scans_of, slow, street

recorded = pytest.mark.parametrize("association", ["vh", "p"])


def built(backend: str, *overrides: str) -> ScanByScan:
    """With all points from the first step on, as those are that are recorded."""
    return build(f"cv+{backend}", f"odometry.{backend}.registration.coarse_stride=1", *overrides)


@recorded
@pytest.mark.parametrize("map_", ["f2m", pytest.param("f2f", marks=slow)])
def test_a_recorded_drive_is_the_same(association, map_, monkeypatch):
    """Images are begun anew, and buffers are filled, moved and made larger on the way."""
    drive = scans_of(street(yaw_step=0.03))
    here = run(built(f"{association}_{map_}"), drive)
    made = pretended_graphs.pretend(monkeypatch)
    monkeypatch.setattr(point_buffer, "_INITIAL_CAPACITY_ON_GPU", 1 << 14)
    there = run(built(f"{association}_{map_}"), drive)
    translations, angles = motion_errors(poses(there), poses(here))
    assert translations.max() < 5e-4 and angles.max() < 5e-3  # less than a step that ends a registration
    assert len(made) >= 8
    for a, b in zip(here, there, strict=True):
        assert (a.health.status, a.health.points) == (b.health.status, b.health.points)
        assert a.health.overlap == pytest.approx(b.health.overlap, abs=1e-3)
        assert a.health.min_information == pytest.approx(b.health.min_information, abs=1e-3)


@recorded
def test_a_recorded_drive_recovers_the_same(association, monkeypatch):
    """From a lost scan, an empty one, a repeated one and a gap after which the map is begun anew."""
    some = scans()
    drive = [*some[:4], *some[5:7], torch.zeros(0, 3), some[8], some[8], *[torch.zeros(0, 3)] * 6, *some[9:12]]
    here = run(built(f"{association}_f2m"), drive)
    pretended_graphs.pretend(monkeypatch)
    there = run(built(f"{association}_f2m"), drive)
    assert [frame.health.status for frame in here] == [frame.health.status for frame in there]
    translations, angles = motion_errors(poses(there), poses(here))
    assert translations.max() < 1e-3 and angles.max() < 1e-2


@pytest.mark.parametrize(("group", "option"), [("residual", "generalized_icp"), ("weight", "cauchy")])
def test_other_settings_are_recorded_or_left_alone(group, option, monkeypatch):
    override = f"{group}@odometry.vh_f2m.registration.{group}={option}"
    here = run(built("vh_f2m", override), scans()[:6])
    pretended_graphs.pretend(monkeypatch)
    there = run(built("vh_f2m", override), scans()[:6])
    translations, angles = motion_errors(poses(there), poses(here))
    assert translations.max() < 1e-3 and angles.max() < 1e-2


def test_a_recorded_network_says_the_same(monkeypatch):
    network = TrainedNetwork(PoseNet().eval(), SphericalProjection(), torch.device("cpu"))
    here = poses(run(InitializationAlone(PoseNetInitialization(network)), scans()[:5]))
    made = pretended_graphs.pretend(monkeypatch)
    there = poses(run(InitializationAlone(PoseNetInitialization(network)), scans()[:5]))
    assert len(made) == 2
    torch.testing.assert_close(there, here, rtol=0, atol=1e-6)
    assert not torch.equal(here[1], se3.identity())


@on_gpu
def test_a_gpu_predicts_the_same_motions():
    projection, network = SphericalProjection(), PoseNet().eval()
    scans_ = [30 * torch.randn(50_000, 3, generator=torch.Generator().manual_seed(i)) for i in range(5)]
    trajectories = []
    for device in (torch.device("cpu"), torch.device("cuda")):
        trained = TrainedNetwork(network.to(device), projection, device)
        trajectories.append(poses(run(InitializationAlone(PoseNetInitialization(trained), device), scans_)))
    translations, angles = motion_errors(*trajectories)
    assert translations.max() < 1e-3 and angles.max() < 1e-2
