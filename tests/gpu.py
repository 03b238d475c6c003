"""The mark of tests that need a GPU."""

import pytest
import torch

_SKIP = pytest.mark.skipif(not torch.cuda.is_available(), reason="needs a CUDA device")


def on_gpu(test):
    """Skip a test on machines without a GPU."""
    return pytest.mark.gpu(_SKIP(test))
