import math
from dataclasses import dataclass

import pytest
import torch

from lidarlearn.registration.weights import Cauchy, CutOff, GemanMcClure, Huber, NoWeight, Proximity, RobustWeight

KERNELS = [NoWeight(), Proximity(), Huber(), CutOff(), GemanMcClure(), Cauchy()]
RESIDUALS = torch.linspace(-3, 3, 601, dtype=torch.float64)


@pytest.mark.parametrize(
    ("kernel", "residual", "distance", "expected"),
    [
        (NoWeight(), 7.0, 9.0, 1.0),
        (Proximity(0.5), 7.0, 0.0, 1.0),
        (Proximity(0.5), 0.0, 0.5, math.exp(-1)),
        (Proximity(0.2), 0.0, 0.6, math.exp(-9)),
        (Huber(0.1), 0.1, 9.0, 1.0),
        (Huber(0.1), -0.4, 9.0, 0.25),
        (CutOff(0.5), -0.5, 9.0, 1.0),
        (CutOff(0.5), 0.51, 0.0, 0.0),
        (GemanMcClure(0.1), 0.1, 9.0, 0.25),
        (GemanMcClure(0.1), -0.3, 9.0, 0.01),
        (Cauchy(0.1), 0.1, 9.0, 0.5),
        (Cauchy(0.1), -0.3, 9.0, 0.1),
    ],
)
def test_weights_equal_closed_forms(kernel, residual, distance, expected):
    weight = kernel.weight(torch.tensor([residual]), torch.tensor([distance**2]))
    assert weight.item() == pytest.approx(expected, rel=1e-5)


@pytest.mark.parametrize("kernel", KERNELS)
def test_weights_fall_symmetrically_from_one_at_zero(kernel):
    weights = kernel.weight(RESIDUALS, RESIDUALS**2)
    assert weights[300] == 1 and (weights >= 0).all() and (weights <= 1).all()
    assert (weights[300:].diff() <= 0).all()
    torch.testing.assert_close(weights, weights.flip(0))


@pytest.mark.parametrize(
    ("kernel", "rho"),
    [
        (Huber(0.3), lambda r: torch.where(r.abs() <= 0.3, r * r / 2, 0.3 * (r.abs() - 0.15))),
        (GemanMcClure(0.3), lambda r: 0.3**2 * r * r / (0.3**2 + r * r) / 2),
        (Cauchy(0.3), lambda r: 0.3**2 / 2 * torch.log1p((r / 0.3) ** 2)),
    ],
)
def test_weights_minimize_robust_cost_of_their_name(kernel, rho):
    """Iteratively reweighted least squares minimizes rho when w(r) = rho'(r) / r."""
    r = RESIDUALS.clone().requires_grad_()
    (gradient,) = torch.autograd.grad(rho(r).sum(), r)
    weights = kernel.weight(RESIDUALS, RESIDUALS**2)
    torch.testing.assert_close(weights * RESIDUALS, gradient)


@pytest.mark.parametrize("kernel", KERNELS)
@pytest.mark.parametrize("shape", [(), (0,), (3, 1, 2)])
def test_weights_have_shape_of_residuals(kernel, shape):
    assert kernel.weight(torch.zeros(shape), torch.zeros(shape)).shape == shape


def test_custom_weight_may_have_further_parameters():
    @dataclass(frozen=True)
    class Barron(RobustWeight):
        alpha: float = -2.0
        scale_m: float = 0.1

        def weight(self, residuals, squared_distances):
            return ((residuals / self.scale_m) ** 2 / abs(self.alpha - 2) + 1) ** (self.alpha / 2 - 1)

    assert Barron().weight(torch.zeros(1), torch.zeros(1)) == 1
    with pytest.raises(ValueError, match=r"weight Barron: scale_m must be above 0, got scale_m=0\.0"):
        Barron(scale_m=0.0)
