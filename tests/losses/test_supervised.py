"""The supervised loss: formula, gradients, bounds."""

import math

import pytest
import torch

from lidarlearn.geometry import se3
from lidarlearn.losses.supervised import SupervisedLoss


def motions(n, seed=0):
    generator = torch.Generator().manual_seed(seed)
    return torch.randn(n, 6, generator=generator, dtype=torch.float64) * torch.tensor([1.0, 0.1, 0.1, 0.02, 0.02, 0.1])


def test_loss_matches_formula():
    truth, estimate = motions(5), motions(5, seed=1)
    loss = SupervisedLoss(initial_s1=0.3, initial_s2=2.0)
    t = ((truth - estimate)[:, :3] ** 2).sum(1)
    e = ((truth - estimate)[:, 3:] ** 2).sum(1)
    expected = (t * math.exp(0.3) + e * math.exp(2.0) - (0.3 + 2.0)).mean()
    result = loss(estimate, se3.from_euler(truth))
    torch.testing.assert_close(result.loss.double(), expected, rtol=1e-6, atol=1e-6)
    torch.testing.assert_close(result.parts["translation_squared_m2"], t.mean())


def test_gradients_of_estimates_and_weights():
    truth, estimate = se3.from_euler(motions(3)), motions(3, seed=1).requires_grad_()
    loss = SupervisedLoss(0.3, 2.0).double()

    def value(p, s1, s2):
        return torch.func.functional_call(loss, {"s1": s1, "s2": s2}, (p, truth)).loss

    s1, s2 = (torch.tensor(s, dtype=torch.float64, requires_grad=True) for s in (0.3, 2.0))
    assert torch.autograd.gradcheck(value, (estimate, s1, s2))


def test_learned_weights_converge_to_precisions():
    truth, estimate = motions(50), motions(50, seed=1)
    loss = SupervisedLoss().double()
    optimizer = torch.optim.Adam(loss.parameters(), lr=0.2)
    for _ in range(120):
        optimizer.zero_grad()
        result = loss(estimate, se3.from_euler(truth))
        result.loss.backward()
        optimizer.step()
    assert loss.s1.item() == pytest.approx(-math.log(result.parts["translation_squared_m2"].item()), abs=0.02)
    assert loss.s2.item() == pytest.approx(-math.log(result.parts["rotation_squared_rad2"].item()), abs=0.02)


def test_weights_are_bounded_and_fall_when_errors_grow():
    truth = motions(4)
    loss = SupervisedLoss(initial_s1=20.0, initial_s2=13.9, max_s=14.0)
    optimizer = torch.optim.Adam(loss.parameters(), lr=0.05)

    def step(estimate):
        optimizer.zero_grad()
        result = loss(estimate.float(), se3.from_euler(truth))
        result.loss.backward()
        optimizer.step()
        return result.loss.item()

    values = [step(truth) for _ in range(20)]
    assert values[-1] == pytest.approx(-28.0, abs=0.01)
    assert max(loss.s1.item(), loss.s2.item()) <= 14.0 + 0.06  # clamped in the next step
    for _ in range(200):
        step(truth + 0.05)
    assert max(loss.s1.item(), loss.s2.item()) < 11
