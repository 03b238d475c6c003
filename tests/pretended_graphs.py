"""CUDA graphs on any machine: operations are noted down and done again on the same memory, with the numbers noted.

It shows that what a recording reads stands where it stood, that nothing which changes was taken for a number, and that
nothing is asked for that a GPU cannot be asked for in advance. Whether CUDA can record an operation it does not show.
"""

from collections.abc import Callable, Sequence
from typing import Any

import pytest
import torch
from torch import Tensor
from torch.utils._python_dispatch import TorchDispatchMode
from torch.utils._pytree import tree_leaves

from lidarlearn import cuda_graphs

_ANSWERS = {"nonzero", "_unique2", "_local_scalar_dense", "masked_select", "equal", "is_nonzero"}  # the CPU waits for


class _Notes(TorchDispatchMode):
    """Every operation that computes something, with what it wrote to."""

    def __init__(self) -> None:
        super().__init__()
        self.operations: list[tuple[Callable, tuple, dict, Any]] = []
        self._overwritten: list[tuple[Tensor, Tensor]] = []

    def __torch_dispatch__(self, func: Any, types: Any, args: tuple = (), kwargs: dict | None = None) -> Any:
        kwargs, name = kwargs or {}, func.overloadpacket.__name__
        is_mask = name in ("index", "index_put_") and any(
            isinstance(index, Tensor) and index.dtype == torch.bool for index in args[1]
        )
        if name in _ANSWERS or is_mask:
            raise RuntimeError(f"{func} is asked for in a recording: the GPU would have to answer")
        if func._schema.is_mutable:
            named = dict(zip((a.name for a in func._schema.arguments), args, strict=False)) | kwargs
            written = [named[a.name] for a in func._schema.arguments if a.is_write and a.name in named]
            self._overwritten += [(tensor, tensor.clone()) for tensor in _tensors(written)]
        result = func(*args, **kwargs)
        if func._schema.is_mutable or not _memory(result) <= _memory((args, kwargs)):
            self.operations.append((func, args, kwargs, None if func._schema.is_mutable else result))
        return result

    def undo(self) -> None:
        """Leave all memory as it was: what is recorded is not done."""
        for tensor, before in reversed(self._overwritten):
            tensor.copy_(before)


class PretendedRecording:
    """In the place of `cuda_graphs.Recording`."""

    def __init__(
        self,
        function: Callable[..., Any],
        inputs: Sequence[Tensor],
        sent: Sequence[Tensor | None],
        answer: Tensor | None,
        device: torch.device,
        pool: Any,
    ) -> None:
        self._inputs, self._sent, self._answer = inputs, sent, answer
        self._receive()
        notes = _Notes()
        try:
            with notes:
                self._result = function(*inputs)
        finally:
            notes.undo()
        self._operations = notes.operations

    def wait(self) -> None:
        pass

    def _receive(self) -> None:
        for place, value in zip(self._inputs, self._sent, strict=True):
            if value is not None:
                place.copy_(value)

    def replay(self) -> Any:
        self._receive()
        for func, args, kwargs, result in self._operations:
            again = func(*args, **kwargs)
            if result is not None:
                for old, new in zip(_tensors(result), _tensors(again), strict=True):
                    assert old.shape == new.shape
                    old.copy_(new)
        if self._answer is not None:
            self._answer.copy_(self._result[0] if isinstance(self._result, tuple) else self._result)
        return self._result


def pretend(monkeypatch: pytest.MonkeyPatch) -> list[PretendedRecording]:
    """Let functions be recorded on the CPU; returns the recordings that will be made."""
    made = []

    def record(*arguments: Any) -> PretendedRecording:
        made.append(PretendedRecording(*arguments))
        return made[-1]

    monkeypatch.setattr(cuda_graphs, "are_used_on", lambda device: True)
    monkeypatch.setattr(cuda_graphs, "Recording", record)
    return made


def _tensors(values: Any) -> list[Tensor]:
    return [value for value in tree_leaves(values) if isinstance(value, Tensor)]


def _memory(values: Any) -> set[int]:
    return {value.untyped_storage().data_ptr() for value in _tensors(values)}
