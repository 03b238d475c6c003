"""The mark of tests that need a GPU."""

import pytest
import torch

_SKIP = pytest.mark.skipif(not torch.cuda.is_available(), reason="needs a CUDA device")


def on_gpu(test):
    """Run a test on machines with a GPU alone."""
    return pytest.mark.gpu(_SKIP(test))
