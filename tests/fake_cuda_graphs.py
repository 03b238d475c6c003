"""CUDA graphs without a GPU: operations are recorded, and replayed on the same memory with the same Python numbers.

They show that what a captured function reads stays at its address, that Python numbers in it are constants, and that it
does not wait for the GPU. They do not show whether CUDA can capture its operations.
"""

from collections.abc import Callable
from typing import Any
from unittest.mock import Mock

import pytest
import torch
from torch import Tensor
from torch.utils._python_dispatch import TorchDispatchMode
from torch.utils._pytree import tree_leaves

from lidarlearn import cuda_graphs
from lidarlearn.cuda_graphs import CapturedGraph

_SYNCHRONIZING = {"nonzero", "_unique2", "_local_scalar_dense", "masked_select", "equal", "is_nonzero"}


class _Recorder(TorchDispatchMode):
    """Records every operation that computes something, and what it overwrites."""

    def __init__(self) -> None:
        super().__init__()
        self._operations: list[tuple[Callable, tuple, dict, Any]] = []
        self._overwritten: list[tuple[Tensor, Tensor]] = []

    def __torch_dispatch__(self, func: Any, types: Any, args: tuple = (), kwargs: dict | None = None) -> Any:
        kwargs, name = kwargs or {}, func.overloadpacket.__name__
        is_mask = name in ("index", "index_put_") and any(
            isinstance(index, Tensor) and index.dtype == torch.bool for index in args[1]
        )
        if name in _SYNCHRONIZING or is_mask:
            raise RuntimeError(f"{func} during capture: the CPU would have to wait for the GPU")
        if func._schema.is_mutable:
            named = dict(zip((a.name for a in func._schema.arguments), args, strict=False)) | kwargs
            written = [named[a.name] for a in func._schema.arguments if a.is_write and a.name in named]
            self._overwritten += [(tensor, tensor.clone()) for tensor in _tensors(written)]
        result = func(*args, **kwargs)
        if func._schema.is_mutable or not _memory(result) <= _memory((args, kwargs)):
            self._operations.append((func, args, kwargs, None if func._schema.is_mutable else result))
        return result

    def undo(self) -> None:
        """Restore all memory: capturing computes nothing."""
        for tensor, before in reversed(self._overwritten):
            tensor.copy_(before)

    def replay(self) -> None:
        """Compute all results again, in the same memory."""
        for func, args, kwargs, result in self._operations:
            again = func(*args, **kwargs)
            if result is not None:
                for old, new in zip(_tensors(result), _tensors(again), strict=True):
                    assert old.shape == new.shape
                    old.copy_(new)


def capture(function: Callable[[], Any], device: torch.device, pool: Any) -> CapturedGraph:
    """Replaces `cuda_graphs.capture`."""
    recorder = _Recorder()
    try:
        with recorder:
            result = function()
    finally:
        recorder.undo()
    graph = Mock(torch.cuda.CUDAGraph)
    graph.replay.side_effect = recorder.replay
    return CapturedGraph(graph, result, stream=Mock(torch.cuda.Stream), done=Mock(torch.cuda.Event))


def install(monkeypatch: pytest.MonkeyPatch) -> list[CapturedGraph]:
    """Capture functions on the CPU; returns a list that all graphs will be appended to."""
    captured = []

    def capture_and_list(*arguments: Any) -> CapturedGraph:
        captured.append(capture(*arguments))
        return captured[-1]

    monkeypatch.setattr(cuda_graphs, "supported_on", lambda device: True)
    monkeypatch.setattr(cuda_graphs, "capture", capture_and_list)
    return captured


def _tensors(values: Any) -> list[Tensor]:
    return [value for value in tree_leaves(values) if isinstance(value, Tensor)]


def _memory(values: Any) -> set[int]:
    return {value.untyped_storage().data_ptr() for value in _tensors(values)}
