"""Odometries with (fake) CUDA graphs find the poses that they find without."""

import pytest
import torch

from lidarlearn.geometry import se3
from lidarlearn.geometry.projection import SphericalProjection
from lidarlearn.models.posenet import PoseNet
from lidarlearn.odometry.base import BaseOdometry
from lidarlearn.odometry.initialization.posenet import PoseNetInitialization
from lidarlearn.odometry.initialization_only import InitializationOnly
from lidarlearn.registration.association import point_buffer
from lidarlearn.training.trained_network import TrainedNetwork
from tests import fake_cuda_graphs
from tests.gpu import on_gpu
from tests.odometry.odometries import build, motion_errors, poses, run, scans, scans_of, slow, street

captured = pytest.mark.parametrize("association", ["vh", "p"])


def built(backend: str, *overrides: str) -> BaseOdometry:
    """Every step uses all points, as with CUDA graphs."""
    return build(f"cv+{backend}", f"odometry.{backend}.registration.coarse_stride=1", *overrides)


@captured
@pytest.mark.parametrize("map_", ["f2m", pytest.param("f2f", marks=slow)])
def test_a_drive_is_the_same(association, map_, monkeypatch):
    """On the way new images are started, and buffers are filled, moved and enlarged."""
    drive = scans_of(street(yaw_step=0.03))
    eager = run(built(f"{association}_{map_}"), drive)
    graphs = fake_cuda_graphs.install(monkeypatch)
    monkeypatch.setattr(point_buffer, "_INITIAL_CAPACITY_ON_GPU", 1 << 14)
    replayed = run(built(f"{association}_{map_}"), drive)
    translations, angles = motion_errors(poses(replayed), poses(eager))
    assert translations.max() < 5e-4 and angles.max() < 5e-3  # less than a step that ends a registration
    assert len(graphs) >= 8
    for a, b in zip(eager, replayed, strict=True):
        assert (a.health.status, a.health.points) == (b.health.status, b.health.points)
        assert a.health.overlap == pytest.approx(b.health.overlap, abs=1e-3)
        assert a.health.min_information == pytest.approx(b.health.min_information, abs=1e-3)


@pytest.mark.parametrize("association", [pytest.param("vh", marks=slow), "p"])
def test_recoveries_are_the_same(association, monkeypatch):
    """From a lost scan, an empty one, a repeated one and a gap after which a new map is started."""
    some = scans()
    drive = [*some[:4], *some[5:7], torch.zeros(0, 3), some[8], some[8], *[torch.zeros(0, 3)] * 6, *some[9:12]]
    eager = run(built(f"{association}_f2m"), drive)
    fake_cuda_graphs.install(monkeypatch)
    replayed = run(built(f"{association}_f2m"), drive)
    assert [frame.health.status for frame in eager] == [frame.health.status for frame in replayed]
    translations, angles = motion_errors(poses(replayed), poses(eager))
    assert translations.max() < 1e-3 and angles.max() < 1e-2


@slow
@pytest.mark.parametrize(("group", "option"), [("residual", "generalized_icp"), ("weight", "cauchy")])
def test_other_settings_are_captured_or_run_eagerly(group, option, monkeypatch):
    override = f"{group}@odometry.vh_f2m.registration.{group}={option}"
    eager = run(built("vh_f2m", override), scans()[:6])
    fake_cuda_graphs.install(monkeypatch)
    replayed = run(built("vh_f2m", override), scans()[:6])
    translations, angles = motion_errors(poses(replayed), poses(eager))
    assert translations.max() < 1e-3 and angles.max() < 1e-2


def test_a_network_estimates_the_same(monkeypatch):
    network = TrainedNetwork(PoseNet().eval(), SphericalProjection(), torch.device("cpu"))
    eager = poses(run(InitializationOnly(PoseNetInitialization(network)), scans()[:5]))
    graphs = fake_cuda_graphs.install(monkeypatch)
    replayed = poses(run(InitializationOnly(PoseNetInitialization(network)), scans()[:5]))
    assert len(graphs) == 2
    torch.testing.assert_close(replayed, eager, rtol=0, atol=1e-6)
    assert not torch.equal(eager[1], se3.identity())


@on_gpu
def test_a_gpu_predicts_the_same_motions():
    projection, network = SphericalProjection(), PoseNet().eval()
    scans_ = [30 * torch.randn(50_000, 3, generator=torch.Generator().manual_seed(i)) for i in range(5)]
    trajectories = []
    for device in (torch.device("cpu"), torch.device("cuda")):
        trained = TrainedNetwork(network.to(device), projection, device)
        trajectories.append(poses(run(InitializationOnly(PoseNetInitialization(trained), device), scans_)))
    translations, angles = motion_errors(*trajectories)
    assert translations.max() < 1e-3 and angles.max() < 1e-2
