"""The loss of training: compiled where that is asked for and works, and the same either way."""

import subprocess
import sys

import pytest
import torch

from lidarlearn.geometry import se3
from lidarlearn.losses.weighted_icp import WeightedIcpLoss
from lidarlearn.training.unsupervised import UnsupervisedModule
from tests.box_world import SMALL, cast
from tests.gpu import on_gpu


def module(**settings) -> UnsupervisedModule:
    """Ready to train, with a network that does not matter."""
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
    """How often something is compiled; it stays as it is."""
    calls = []

    def compile_(function, **_):
        calls.append(function)
        return function

    monkeypatch.setattr(torch, "compile", compile_)
    return calls


@pytest.mark.parametrize(("compile_loss", "times"), [("auto", 0), (False, 0), (True, 1)])
def test_the_loss_is_compiled_once_and_on_a_cpu_only_where_that_is_asked_for(compilations, compile_loss, times):
    trained = module(compile_loss=compile_loss)
    for _ in range(3):
        trained.compute_loss(estimates(), batch())
    assert len(compilations) == times


def test_the_loss_of_validation_is_not_compiled(compilations):
    """Its batches come in several sizes."""
    validated = module(compile_loss=True).eval()
    validated.compute_loss(estimates(), batch())
    assert not compilations


def test_what_is_compiled_is_no_part_of_a_checkpoint(compilations):
    trained = module(compile_loss=True)
    before = trained.state_dict().keys()
    trained.compute_loss(estimates(), batch())
    assert trained.state_dict().keys() == before


class _NoWayBack(torch.autograd.Function):
    """Compiles one way only."""

    @staticmethod
    def forward(ctx, x):
        return x.clone()

    @staticmethod
    def backward(ctx, gradient):
        raise RuntimeError("no compiler found\nand a long story why")


@pytest.mark.parametrize("way", ["forward", "backward"])
def test_where_compiling_fails_training_goes_on_without(monkeypatch, way):
    def broken(function, **_):
        def run(parameters, *others):
            if way == "forward":
                raise RuntimeError("no compiler found\nand a long story why")
            return function(_NoWayBack.apply(parameters), *others)

        return run

    monkeypatch.setattr(torch, "compile", broken)
    trained, parameters = module(compile_loss=True), estimates()
    with pytest.warns(UserWarning, match=r"RuntimeError: no compiler found\n  change: module\.compile_loss=false"):
        result = trained.compute_loss(parameters, batch())
    result.loss.backward()
    assert parameters.grad.abs().sum() > 0
    assert result.loss == WeightedIcpLoss()(parameters, *batch().values(), SMALL).loss
    trained.compute_loss(parameters, batch())  # and says so once


@pytest.mark.parametrize("rank", [0, 1, 2])
def test_each_process_of_a_training_has_a_chance_of_its_own(monkeypatch, rank):
    """All begin with that of the seed or the checkpoint; the first one keeps it, as if it were alone."""
    drawn = []
    for own in (0, rank):
        monkeypatch.setattr(UnsupervisedModule, "global_rank", own)
        torch.manual_seed(3)
        module().on_train_start()
        drawn.append(torch.rand(4))
    assert torch.equal(*drawn) == (rank == 0)


def test_another_word_than_auto_is_refused():
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
def test_compiled_it_is_the_same_loss():
    """In a process without checks of shapes, which do not compile."""
    subprocess.run([sys.executable, "-c", _COMPARISON], check=True)


@on_gpu
def test_a_gpu_computes_the_same_loss_and_gradient():
    here, there = estimates(), estimates().detach().cuda().requires_grad_()
    on_gpu = {key: maps.cuda() for key, maps in batch().items()}
    losses = [
        module().compute_loss(here, batch()).loss,
        module(compile_loss=False).cuda().compute_loss(there, on_gpu).loss,
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
def test_compiled_for_a_gpu_it_is_the_same_loss():
    subprocess.run([sys.executable, "-c", _ON_GPU], check=True)
