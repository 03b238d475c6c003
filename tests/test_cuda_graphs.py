"""The graph cache, with fake CUDA graphs; see `fake_cuda_graphs` for what they show."""

import pytest
import torch
from torch import Tensor

from lidarlearn.cuda_graphs import GraphCache, Padding
from lidarlearn.geometry.voxels import grid_sample
from tests import fake_cuda_graphs

CPU = torch.device("cpu")


def test_functions_run_eagerly_without_cuda_graphs():
    graphs, called = GraphCache(), []

    def count(values: Tensor) -> Tensor:
        called.append(len(values))
        return values.sum()

    for length in (3, 3, 3):
        assert graphs(count, torch.ones(length), device=CPU, padding=Padding()) == length
    assert called == [3, 3, 3]


def test_function_is_called_then_captured_then_replayed(monkeypatch):
    captured, graphs, called = fake_cuda_graphs.install(monkeypatch), GraphCache(), []

    def double(values: Tensor) -> Tensor:
        called.append(True)
        return 2 * values

    for i in range(5):
        assert torch.equal(graphs(double, torch.full((4,), float(i)), device=CPU), torch.full((4,), 2.0 * i))
    assert len(called) == 2 and len(captured) == 1
    graphs(double, torch.ones(5), device=CPU)
    graphs(double, torch.ones(4), device=CPU, settings="others")
    graphs(double, torch.ones(4, dtype=torch.float64), device=CPU)
    assert len(called) == 5
    graphs.clear()
    graphs(double, torch.ones(4), device=CPU)
    assert len(called) == 6 and len(captured) == 1


def test_padded_lengths_share_a_graph(monkeypatch):
    captured, graphs = fake_cuda_graphs.install(monkeypatch), GraphCache()

    def numbers(rows: Tensor) -> Tensor:
        return rows.isfinite().sum()

    for length in (700, 650, 760, 700):
        assert graphs(numbers, torch.ones(length, 1), device=CPU, padding=Padding()) == length
    assert len(captured) == 1


def test_kept_first_argument_is_copied_once(monkeypatch):
    fake_cuda_graphs.install(monkeypatch)
    graphs, kept, other = GraphCache(), torch.ones(3), torch.full((3,), 5.0)

    def total(values: Tensor, factor: Tensor) -> Tensor:
        return values.sum() * factor

    def call(values: Tensor, factor: float) -> float:
        return float(graphs(total, values, torch.tensor(factor), device=CPU, keeps_first=True, reads_first=True))

    assert [call(kept, 1.0), call(kept, 2.0), call(other, 2.0), call(kept, 3.0)] == [3.0, 6.0, 30.0, 9.0]


def test_empty_inputs_are_not_captured(monkeypatch):
    captured, graphs = fake_cuda_graphs.install(monkeypatch), GraphCache()
    for _ in range(3):
        assert len(graphs(lambda values: values + 1, torch.zeros(0, 3), device=CPU, padding=Padding())) == 0
    assert not captured


def test_function_that_cannot_be_captured_runs_eagerly_and_warns(monkeypatch):
    """Such as a custom robust weight that reads a value from the GPU."""
    fake_cuda_graphs.install(monkeypatch)
    graphs, seen = GraphCache(), torch.zeros(3)

    def positive(values: Tensor) -> Tensor:
        seen.add_(values)
        return values[values > 0]

    def call() -> Tensor:
        return graphs(positive, torch.tensor([1.0, -1.0, 2.0]), device=CPU, reads_first=True)

    assert call().tolist() == [1.0, 2.0]
    with pytest.warns(UserWarning, match="cannot be a CUDA graph: .* the CPU would have to wait"):
        assert call().tolist() == [1.0, 2.0]
    assert call().tolist() == [1.0, 2.0]
    assert seen.tolist() == [3.0, -3.0, 6.0]


@pytest.mark.parametrize(
    "padding", [Padding(), Padding(step=4096), Padding(to_power_of_two=True)], ids=["default", "step", "power_of_two"]
)
def test_padding_maps_many_lengths_to_few(padding):
    lengths = {padding.length(rows) for rows in range(1, 200_000, 31)}
    assert len(lengths) <= 60
    assert all(rows <= padding.length(rows) for rows in range(1, 10_000, 3))
    if padding == Padding():
        assert all(padding.length(rows) <= 1.5 * rows for rows in range(2000, 200_000, 31))


def test_captured_grid_sampling_equals_eager(monkeypatch):
    generator = torch.Generator().manual_seed(0)
    scans = [50 * torch.rand(n, 3, generator=generator) - 25 for n in (1000, 1000, 900, 1024, 1, 0)]
    here = [grid_sample(points, 0.7) for points in scans]
    captured, graphs = fake_cuda_graphs.install(monkeypatch), GraphCache()
    for points, index in zip(scans, here, strict=True):
        assert torch.equal(grid_sample(points, 0.7, graphs), index)
    assert len(captured) == 1
