"""Poses live on the CPU, points on the device of the odometry, and little passes between them."""

import multiprocessing
from concurrent.futures import ProcessPoolExecutor

import numpy as np
import pytest
import torch
from hydra.utils import instantiate

from lidarlearn.evaluation.convergence import Basin, Probe, convergence_basin
from tests import pretend_device
from tests.odometry.odometries import (
    ASSOCIATIONS,
    build,
    configured,
    poses,
    run,
    slow,
    street,
    street_frames,
    street_scans,
)

SCANS = 5
LAUNCHES, TRANSFERS = 1500, 100  # at most, for a scan


def run_elsewhere(association: str, scans: list[np.ndarray]) -> tuple[np.ndarray, int, int]:
    """Poses, and the launches and transfers of the last scan."""
    torch.set_num_threads(1)  # as in the process that asks: sums are then equal to the bit
    with pretend_device.pretended() as device:
        odometry = build(f"cv+{association}_f2m", f"device={pretend_device.NAME}:0")
        *before, last = map(torch.from_numpy, scans)
        frames = run(odometry, before)
        device.launches = device.transfers = 0
        frames += run(odometry, [last])
    return poses(frames).numpy(), device.launches, device.transfers


def basin(association: str, device: str) -> Basin:
    """Of a backend on a device, from a few initial poses of one scan."""
    probe = Probe(offsets_m=[0.5], angles_deg=[4.0], directions=2, every=2)
    backend = instantiate(configured(f"device={device}").odometry[f"{association}_f2m"])
    return convergence_basin(backend, street(frames=3), probe, device)


def basin_elsewhere(association: str) -> Basin:
    torch.set_num_threads(1)
    with pretend_device.pretended():
        return basin(association, f"{pretend_device.NAME}:0")


@pytest.mark.skipif(not pretend_device.IS_SUPPORTED, reason="needs a more recent torch")
@slow
@pytest.mark.parametrize("association", ASSOCIATIONS)
def test_basins_are_same_on_other_device(association):
    with ProcessPoolExecutor(1, multiprocessing.get_context("spawn")) as process:
        elsewhere = process.submit(basin_elsewhere, association).result()
    assert elsewhere == basin(association, "cpu")
    assert elsewhere.scans == 1 and elsewhere.by_offset_m[0.5] > 0


@pytest.mark.skipif(not pretend_device.IS_SUPPORTED, reason="needs a more recent torch")
@slow
@pytest.mark.parametrize("association", ASSOCIATIONS)
def test_odometry_keeps_tensors_on_its_device(association):
    scans = [points.numpy() for points in street_scans()[:SCANS]]
    with ProcessPoolExecutor(1, multiprocessing.get_context("spawn")) as process:
        elsewhere, launches, transfers = process.submit(run_elsewhere, association, scans).result()
    expected = poses(street_frames(f"cv+{association}_f2m")[:SCANS])
    assert np.array_equal(elsewhere, expected.numpy())
    assert 0 < launches < LAUNCHES and 0 < transfers < TRANSFERS
