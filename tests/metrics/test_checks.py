import pytest
import torch

from lidarlearn.geometry import se3
from lidarlearn.metrics.checks import check_comparable


@pytest.mark.parametrize("which", [0, 1], ids=["estimated", "ground_truth"])
def test_check_comparable_refuses_float32(which):
    poses = [se3.identity(3), se3.identity(3)]
    check_comparable(*poses)
    poses[which] = poses[which].float()
    name = ("estimated", "ground-truth")[which]
    with pytest.raises(ValueError, match=rf"^{name} poses must be float64 tensors, got Tensor of torch\.float32$"):
        check_comparable(*poses)


def test_check_comparable_refuses_numpy():
    compare = getattr(check_comparable, "__wrapped__", check_comparable)  # without jaxtyping's checks
    with pytest.raises(ValueError, match="must be float64 tensors, got ndarray of float64"):
        compare(torch.eye(4, dtype=torch.float64).repeat(3, 1, 1).numpy(), se3.identity(3))
