import pytest
import torch

from lidarlearn.geometry import se3
from lidarlearn.metrics.checks import check_comparable


@pytest.mark.parametrize("which", [0, 1])
def test_single_precision_is_refused_and_named(which):
    poses = [se3.identity(3), se3.identity(3)]
    check_comparable(*poses)
    poses[which] = poses[which].float()
    name = ("estimated", "ground-truth")[which]
    with pytest.raises(ValueError, match=rf"^{name} poses must be float64 tensors, got Tensor of torch\.float32$"):
        check_comparable(*poses)


def test_poses_of_numpy_are_no_tensors():
    compare = getattr(check_comparable, "__wrapped__", check_comparable)  # past the checks of types that tests have
    with pytest.raises(ValueError, match="must be float64 tensors, got ndarray of float64"):
        compare(torch.eye(4, dtype=torch.float64).repeat(3, 1, 1).numpy(), se3.identity(3))
