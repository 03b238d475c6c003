"""Odometries with (fake) CUDA graphs find the poses that they find without."""

import pytest
import torch

from lidarlearn.cuda_graphs import CapturedGraph, Padding
from lidarlearn.geometry import se3
from lidarlearn.geometry.projection import SphericalProjection
from lidarlearn.models.posenet import PoseNet
from lidarlearn.odometry.base import BaseOdometry
from lidarlearn.odometry.initialization.posenet import PoseNetInitialization
from lidarlearn.odometry.initialization_only import InitializationOnly
from lidarlearn.registration.association import point_buffer, projective
from lidarlearn.simulation.sensors import hdl64
from lidarlearn.training.trained_network import TrainedNetwork
from tests import fake_cuda_graphs
from tests.gpu import on_gpu
from tests.odometry.odometries import build, motion_errors, poses, run, scans_of, slow, street, street_scans


def built(backend: str, *overrides: str) -> BaseOdometry:
    """Every step uses all points, as with CUDA graphs."""
    settings = ["registration.coarse_stride=1", "hypothesis_points=200"]
    return build(f"cv+{backend}", *(f"odometry.{backend}.{setting}" for setting in settings), *overrides)


def install_graphs(monkeypatch: pytest.MonkeyPatch, capacity: int = 1 << 14) -> list[CapturedGraph]:
    """Fake CUDA graphs, with small buffers and paddings, so that replays are quick and buffers are enlarged."""
    monkeypatch.setattr(point_buffer, "_INITIAL_CAPACITY_ON_GPU", capacity)
    monkeypatch.setattr(projective, "_MAP_PADDING", Padding(step=1 << 17))
    return fake_cuda_graphs.install(monkeypatch)


@pytest.mark.parametrize(("association", "capacity"), [pytest.param("vh", 1 << 13, marks=slow), ("p", 1 << 14)])
@pytest.mark.parametrize("map_", ["f2m", pytest.param("f2f", marks=slow)])
def test_graphs_give_same_drive(association, capacity, map_, monkeypatch):
    """Buffers are enlarged halfway, so that all functions are captured again; every second scan starts an image."""
    drive = scans_of(street(frames=10, yaw_step=0.03, sensor=hdl64(columns=256)))
    eager = run(built(f"{association}_{map_}"), drive)
    graphs = install_graphs(monkeypatch, capacity)
    replayed = run(built(f"{association}_{map_}"), drive)
    translations, angles = motion_errors(poses(replayed), poses(eager))
    assert translations.max() < 5e-4 and angles.max() < 5e-3  # less than a step that ends a registration
    assert len(graphs) >= 8
    for a, b in zip(eager, replayed, strict=True):
        assert (a.health.status, a.health.points) == (b.health.status, b.health.points)
        assert a.health.overlap == pytest.approx(b.health.overlap, abs=1e-3)
        assert a.health.min_information == pytest.approx(b.health.min_information, abs=1e-3)


@slow
@pytest.mark.parametrize("association", ["vh", "p"])
def test_graphs_give_same_recoveries(association, monkeypatch):
    """From a lost scan, an empty one, a repeated one and a gap after which a new map is started."""
    some, empty = street_scans(), torch.zeros(0, 3)
    drive = [*some[:3], *some[4:6], empty, some[7], some[7], *[empty] * 6, *some[8:]]
    eager = run(built(f"{association}_f2m"), drive)
    install_graphs(monkeypatch)
    replayed = run(built(f"{association}_f2m"), drive)
    assert [frame.health.status for frame in eager] == [frame.health.status for frame in replayed]
    translations, angles = motion_errors(poses(replayed), poses(eager))
    assert translations.max() < 1e-3 and angles.max() < 1e-2


@slow
@pytest.mark.parametrize(("group", "option"), [("residual", "generalized_icp"), ("weight", "cauchy")])
def test_graphs_give_same_poses_with_other_settings(group, option, monkeypatch):
    """Generalized ICP is not captured."""
    override = f"{group}@odometry.vh_f2m.registration.{group}={option}"
    eager = run(built("vh_f2m", override), street_scans()[:6])
    install_graphs(monkeypatch)
    replayed = run(built("vh_f2m", override), street_scans()[:6])
    translations, angles = motion_errors(poses(replayed), poses(eager))
    assert translations.max() < 1e-3 and angles.max() < 1e-2


def test_graphs_give_same_network_estimates(monkeypatch):
    network = TrainedNetwork(PoseNet().eval(), SphericalProjection(32, 180), torch.device("cpu"))
    eager = poses(run(InitializationOnly(PoseNetInitialization(network)), street_scans()[:4]))
    graphs = fake_cuda_graphs.install(monkeypatch)
    replayed = poses(run(InitializationOnly(PoseNetInitialization(network)), street_scans()[:4]))
    assert len(graphs) == 2
    torch.testing.assert_close(replayed, eager, rtol=0, atol=1e-6)
    assert not torch.equal(eager[1], se3.identity())


@on_gpu
def test_network_on_gpu_estimates_same_motions():
    projection, network = SphericalProjection(), PoseNet().eval()
    scans_ = [30 * torch.randn(50_000, 3, generator=torch.Generator().manual_seed(i)) for i in range(5)]
    trajectories = []
    for device in (torch.device("cpu"), torch.device("cuda")):
        trained = TrainedNetwork(network.to(device), projection, device)
        trajectories.append(poses(run(InitializationOnly(PoseNetInitialization(trained), device), scans_)))
    translations, angles = motion_errors(*trajectories)
    assert translations.max() < 1e-3 and angles.max() < 1e-2
