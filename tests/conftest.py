"""Fixtures that several packages' tests share."""

import os
from pathlib import Path

import pytest
import torch

if "PYTEST_XDIST_WORKER" in os.environ:
    torch.set_num_threads(1)  # the tests share the cores, one process each


@pytest.fixture(scope="session")
def real_data() -> Path:
    """The folder of real scans; tests that need it are marked `realdata` and skip without it."""
    folder = os.environ.get("LIDARLEARN_TEST_DATA")
    if not folder:
        pytest.skip("set LIDARLEARN_TEST_DATA to the folder of real scans to run this test")
    return Path(folder)
