"""Unsupervised training: its loss, compiled or not, and the random numbers of its processes."""

import subprocess
import sys

import pytest
import torch

from lidarlearn.geometry import se3
from lidarlearn.losses.weighted_icp import WeightedIcpLoss
from lidarlearn.training.unsupervised import UnsupervisedModule
from tests.box_world import SMALL, cast
from tests.gpu import on_gpu

pytestmark = pytest.mark.usefixtures("small_network")


def module(**settings) -> UnsupervisedModule:
    """Ready to train."""
    part = {"_target_": "torch.optim.SGD"}
    model = {"_target_": "lidarlearn.models.posenet.PoseNet"}
    loss = {"_target_": "lidarlearn.losses.weighted_icp.WeightedIcpLoss"}
    image = {key: getattr(SMALL, key) for key in ("height", "width", "fov_up_deg", "fov_down_deg")}
    return UnsupervisedModule(model, loss, part, part, {"projection": image}, **settings).train()


def batch(pairs: int = 2) -> dict:
    """Pairs of scans of the box world."""
    poses = [se3.from_euler(torch.tensor([0.3 * i, 0, 0, 0, 0, 0.02 * i])) for i in range(pairs + 1)]
    maps = torch.stack([SMALL.vertex_map(cast(T)) for T in poses])
    return {"reference": maps[:-1], "target": maps[1:]}


def estimates(pairs: int = 2) -> torch.Tensor:
    return torch.full((pairs, 6), 0.01).requires_grad_()


@pytest.fixture
def compilations(monkeypatch):
    """The functions given to torch.compile, which returns them as they are."""
    calls = []

    def compile_(function, **_):
        calls.append(function)
        return function

    monkeypatch.setattr(torch, "compile", compile_)
    return calls


@pytest.mark.parametrize(("compile_loss", "times"), [("auto", 0), (False, 0), (True, 1)])
def test_training_loss_is_compiled_once_and_on_cpu_only_if_set(compilations, compile_loss, times):
    trained = module(compile_loss=compile_loss)
    for _ in range(3):
        trained.compute_loss(estimates(), batch())
    assert len(compilations) == times


def test_validation_loss_is_not_compiled(compilations):
    """Its batches come in several sizes."""
    validated = module(compile_loss=True).eval()
    validated.compute_loss(estimates(), batch())
    assert not compilations


def test_compiled_loss_is_not_in_state_dict(compilations):
    trained = module(compile_loss=True)
    before = trained.state_dict().keys()
    trained.compute_loss(estimates(), batch())
    assert trained.state_dict().keys() == before


class _BrokenBackward(torch.autograd.Function):
    """Fails in the backward pass."""

    @staticmethod
    def forward(ctx, x):
        return x.clone()

    @staticmethod
    def backward(ctx, gradient):
        raise RuntimeError("no compiler found\nand a long story why")


@pytest.mark.parametrize("direction", ["forward", "backward"])
def test_training_continues_without_compilation_if_it_fails(monkeypatch, direction):
    def broken(function, **_):
        def run(parameters, *others):
            if direction == "forward":
                raise RuntimeError("no compiler found\nand a long story why")
            return function(_BrokenBackward.apply(parameters), *others)

        return run

    monkeypatch.setattr(torch, "compile", broken)
    trained, parameters = module(compile_loss=True), estimates()
    with pytest.warns(UserWarning, match=r"RuntimeError: no compiler found\n  change: module\.compile_loss=false"):
        result = trained.compute_loss(parameters, batch())
    result.loss.backward()
    assert parameters.grad.abs().sum() > 0
    assert result.loss == WeightedIcpLoss()(parameters, *batch().values(), SMALL).loss
    trained.compute_loss(parameters, batch())  # warns only once


@pytest.mark.parametrize("rank", [0, 1, 2])
def test_each_process_has_its_own_random_numbers(monkeypatch, rank):
    """All start with the same seed or checkpoint; the first keeps its state, like a single process."""
    drawn = []
    for own in (0, rank):
        monkeypatch.setattr(UnsupervisedModule, "global_rank", own)
        torch.manual_seed(3)
        module().on_train_start()
        drawn.append(torch.rand(4))
    assert torch.equal(*drawn) == (rank == 0)


def test_compile_loss_refuses_other_words_than_auto():
    with pytest.raises(ValueError, match="true, false or auto, got 'always'"):
        module(compile_loss="always")


_COMPARISON = """
import torch
from torch._dynamo import config
from torch._dynamo.utils import counters
from tests.training.test_unsupervised import batch, estimates, module

config.error_on_recompile = True
trained, as_it_is = module(compile_loss=True), module(compile_loss=False)
for bf16 in (False, True):
    for scale in (1.0, 1.1):
        with torch.autocast("cpu", torch.bfloat16, enabled=bf16):
            some = {key: scale * value for key, value in batch().items()}
            both = []
            for one in (trained, as_it_is):
                parameters = estimates()
                one._loss(2 * parameters, some).loss.backward()
                both.append((one._loss(2 * parameters, some), parameters.grad))
        (fast, pull), (slow, slow_pull) = both
        torch.testing.assert_close(fast.loss, slow.loss, rtol=1e-3, atol=0)
        torch.testing.assert_close(pull, slow_pull, rtol=1e-2, atol=1e-2 * float(slow_pull.abs().max()))
        for part in slow.parts:
            torch.testing.assert_close(fast.parts[part], slow.parts[part], rtol=1e-2, atol=0)
    trained._training_loss = None  # a training is either in 16 bits or not
    torch._dynamo.reset()
trained.eval().compute_loss(estimates(1), batch(1))
assert counters["stats"]["unique_graphs"] == 2 and not counters["graph_break"], counters
"""


@pytest.mark.slow
def test_compiled_loss_equals_eager_loss():
    """In a process without jaxtyping's checks, which do not compile."""
    subprocess.run([sys.executable, "-c", _COMPARISON], check=True)


@on_gpu
def test_loss_and_gradient_on_gpu_equal_those_on_cpu():
    here, there = estimates(), estimates().detach().cuda().requires_grad_()
    batch_there = {key: maps.cuda() for key, maps in batch().items()}
    losses = [
        module().compute_loss(here, batch()).loss,
        module(compile_loss=False).cuda().compute_loss(there, batch_there).loss,
    ]
    for loss in losses:
        loss.backward()
    torch.testing.assert_close(losses[1].cpu(), losses[0], rtol=1e-3, atol=1e-6)
    torch.testing.assert_close(there.grad.cpu(), here.grad, rtol=1e-2, atol=1e-5)


_ON_GPU = """
import torch
from tests.training.test_unsupervised import batch, estimates, module

results = []
for compile_loss in (True, False):
    trained, parameters = module(compile_loss=compile_loss).cuda(), estimates().detach().cuda().requires_grad_()
    loss = trained.compute_loss(parameters, {key: maps.cuda() for key, maps in batch().items()}).loss
    loss.backward()
    results.append((loss, parameters.grad))
    assert (trained._training_loss == trained.loss.forward) != compile_loss, "it was not compiled"
(fast, pull), (slow, slow_pull) = results
torch.testing.assert_close(fast, slow, rtol=1e-3, atol=0)
torch.testing.assert_close(pull, slow_pull, rtol=1e-2, atol=1e-2 * float(slow_pull.abs().max()))
"""


@on_gpu
@pytest.mark.slow
def test_compiled_loss_on_gpu_equals_eager_loss():
    subprocess.run([sys.executable, "-c", _ON_GPU], check=True)
