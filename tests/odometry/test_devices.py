"""Poses live on the CPU, points on the device of the odometry, and little passes between them."""

import multiprocessing
from concurrent.futures import ProcessPoolExecutor

import pytest
import torch
from hydra.utils import instantiate
from torch import Tensor

from lidarlearn.evaluation.convergence import Basin, Probe, convergence_basin
from tests import pretend_device
from tests.odometry.odometries import ASSOCIATIONS, build, composed, kd_at_least, poses, run, scans, street

SCANS = 5
LAUNCHES, TRANSFERS = 1500, 100  # at most, for a scan


def run_elsewhere(association: str) -> tuple[Tensor, int, int]:
    """Poses, and what the last scan asked of the device."""
    torch.set_num_threads(1)  # as in the process that asks: sums are then equal to the bit
    with pretend_device.pretended() as device:
        odometry = build(f"cv+{association}_f2m", f"device={pretend_device.NAME}:0")
        *before, last = scans()[:SCANS]
        frames = run(odometry, before)
        device.launches = device.transfers = 0
        frames += run(odometry, [last])
    return poses(frames), device.launches, device.transfers


def basin(association: str, device: str) -> Basin:
    """Of a backend on a device, from a few initial poses of one scan."""
    probe = Probe(offsets_m=[0.5], angles_deg=[4.0], directions=2, every=2)
    backend = instantiate(
        composed("projection@data.projection=hdl64", f"device={device}").odometry[f"{association}_f2m"]
    )
    return convergence_basin(backend, street(frames=3), probe, device)


def basin_elsewhere(association: str) -> Basin:
    torch.set_num_threads(1)
    with pretend_device.pretended():
        return basin(association, f"{pretend_device.NAME}:0")


@pytest.mark.skipif(not pretend_device.IS_SUPPORTED, reason="needs a more recent torch")
@pytest.mark.slow
@pytest.mark.parametrize("association", ASSOCIATIONS)
def test_basins_are_measured_on_another_device(association):
    with ProcessPoolExecutor(1, multiprocessing.get_context("spawn")) as process:
        elsewhere = process.submit(basin_elsewhere, association).result()
    assert elsewhere == basin(association, "cpu")
    assert elsewhere.scans == 1 and elsewhere.by_offset_m[0.5] > 0


@pytest.mark.skipif(not pretend_device.IS_SUPPORTED, reason="needs a more recent torch")
@kd_at_least
def test_nothing_is_left_on_another_device(association):
    with ProcessPoolExecutor(1, multiprocessing.get_context("spawn")) as process:
        elsewhere, launches, transfers = process.submit(run_elsewhere, association).result()
    here = poses(run(build(f"cv+{association}_f2m"), scans()[:SCANS]))
    assert torch.equal(elsewhere, here)
    assert 0 < launches < LAUNCHES and 0 < transfers < TRANSFERS
