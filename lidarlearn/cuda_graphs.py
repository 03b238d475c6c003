"""CUDA graphs: functions that are called again and again are captured once and replayed from then on.

A scan takes about a thousand small operations on a GPU, and the CPU needs longer to launch each than the GPU to run it.
"""

import contextlib
import functools
import warnings
from collections.abc import Callable, Hashable, Sequence
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor


def supported_on(device: torch.device) -> bool:
    """Whether a device has CUDA graphs.

    Captured code cannot wait for the GPU: it must read no value from it, and no size that depends on values. Code that
    branches on this function avoids such reads in one branch.
    """
    return device.type == "cuda"


@dataclass(frozen=True)
class Padding:
    """Pads tensors with rows, so that many lengths share few graphs.

    Args:
        value: fills the added rows.
        step: lengths are rounded up to a multiple of this, or of a quarter of the next power of two if that is more.
        to_power_of_two: lengths are rounded up to a power of two instead.
    """

    value: float = torch.nan
    step: int = 256
    to_power_of_two: bool = False

    def length(self, rows: int) -> int:
        """Number of rows with padding."""
        next_power = 1 << max(rows - 1, 1).bit_length()
        return rows + -rows % (next_power if self.to_power_of_two else max(next_power // 4, self.step))

    def write(self, rows: Tensor, into: Tensor) -> None:
        """Copy rows into a longer tensor, and fill the rest with the value."""
        into[: len(rows)].copy_(rows)
        into[len(rows) :].fill_(self.value)


class GraphCache:
    """Calls functions of tensors; on a GPU, the second call captures a CUDA graph, which later calls replay.

    There is a graph for each combination of settings, device, shapes and dtypes. Functions that CUDA cannot capture
    run eagerly, with a warning; so do all functions on devices without CUDA graphs.

    A result is valid until the next call of any function: graphs share memory.
    """

    _MAX_GRAPHS = 64  # more than an odometry needs; each keeps a few megabytes

    def __init__(self) -> None:
        self._calls: dict[Hashable, _StaticCall] = {}
        self._pool: Any = None

    def clear(self) -> None:
        """Free all graphs, as when the memory that their functions read is replaced."""
        self._calls.clear()
        self._pool = None

    def __call__(
        self,
        function: Callable[..., Any],
        *inputs: Tensor,
        device: torch.device,
        settings: Hashable = (),
        padding: Padding | None = None,
        keeps_first: bool = False,
        reads_first: bool = False,
    ) -> Any:
        """Call a function, or replay its graph.

        Args:
            function: reads only its inputs, tensors that stay at the same address, and constants; calls with equal
                settings pass the same function.
            inputs: its arguments, on any device; the function gets them on `device`.
            device: where it runs.
            settings: distinguishes functions, and their constants, from each other.
            padding: of the first input, where functions are captured.
            keeps_first: whether the first input is unchanged if it is the same tensor as in the last call.
            reads_first: whether to return the result, or the first of several, on the CPU.
        """
        if not supported_on(device) or not all(value.numel() for value in inputs):
            result = function(*(value.to(device) for value in inputs))
            return _with_first_on_cpu(result) if reads_first else result
        shapes = [tuple(value.shape) for value in inputs]
        if padding is not None:
            shapes[0] = (padding.length(len(inputs[0])), *shapes[0][1:])
        key = (settings, device, *shapes, *(value.dtype for value in inputs))
        if key not in self._calls:
            if len(self._calls) >= self._MAX_GRAPHS:
                self.clear()
            self._pool = self._pool or _pool()
            self._calls[key] = _StaticCall(inputs, shapes, device, self._pool, padding, reads_first)
        return self._calls[key](function, inputs, keeps_first)


class _StaticCall:
    """A function with static inputs: its first call is eager, the second captures it, later ones replay it.

    Inputs from the CPU, and a result for the CPU, pass through pinned memory; the graph contains these copies.

    Args:
        inputs: the arguments of the first call.
        shapes: shapes of the static inputs, with padding.
        device: where the function runs.
        pool: memory that graphs share.
        padding: of the first input.
        reads_first: see `GraphCache.__call__`.
    """

    def __init__(
        self,
        inputs: Sequence[Tensor],
        shapes: Sequence[tuple[int, ...]],
        device: torch.device,
        pool: Any,
        padding: Padding | None,
        reads_first: bool,
    ) -> None:
        both = list(zip(inputs, shapes, strict=True))
        self._inputs = [torch.empty(shape, dtype=value.dtype, device=device) for value, shape in both]
        self._pinned = [_pinned(shape, value.dtype) if value.device.type == "cpu" else None for value, shape in both]
        self._device, self._pool, self._padding, self._reads_first = device, pool, padding, reads_first
        self._pinned_result: Tensor | None = None
        self._last_first: Tensor | None = None
        self._eager_calls = 0
        self._captured: CapturedGraph | None = None

    def __call__(self, function: Callable[..., Any], inputs: Sequence[Tensor], keeps_first: bool) -> Any:
        """The function's result."""
        if self._captured is not None:
            self._captured.done.synchronize()  # it may still read pinned inputs; returns at once if not recorded
        for i, value in enumerate(inputs):
            if i or not (keeps_first and value is self._last_first):
                self._write(i, value)
        if self._captured is None and self._eager_calls == 1:
            self._capture(function)
        return self._call(function) if self._captured is None else self._replay(self._captured)

    def _write(self, i: int, value: Tensor) -> None:
        """Copy an input to its static or pinned memory."""
        pinned = self._pinned[i]
        memory = self._inputs[i] if pinned is None else pinned
        if i == 0:
            self._last_first = value
        if i == 0 and self._padding is not None:
            self._padding.write(value, into=memory)
        else:
            memory.copy_(value)

    def _copy_pinned_inputs(self, non_blocking: bool) -> None:
        for static, pinned in zip(self._inputs, self._pinned, strict=True):
            if pinned is not None:
                static.copy_(pinned, non_blocking=non_blocking)

    def _call(self, function: Callable[..., Any]) -> Any:
        self._copy_pinned_inputs(non_blocking=False)
        result = function(*self._inputs)
        self._eager_calls += 1
        if not self._reads_first:
            return result
        self._pinned_result = _pinned(_first(result).shape, _first(result).dtype)
        return _with_first_on_cpu(result)

    def _capture(self, function: Callable[..., Any]) -> None:
        def copy_and_call() -> Any:
            self._copy_pinned_inputs(non_blocking=True)
            result = function(*self._inputs)
            if self._pinned_result is not None:
                self._pinned_result.copy_(_first(result), non_blocking=True)
            return result

        try:
            self._captured = capture(copy_and_call, self._device, self._pool)
        except RuntimeError as error:
            reason = str(error).partition("\n")[0]
            warnings.warn(f"slower than necessary: {function} cannot be a CUDA graph: {reason}", stacklevel=4)

    def _replay(self, captured: "CapturedGraph") -> Any:
        captured.graph.replay()
        if self._pinned_result is not None:
            captured.stream.synchronize()
            return _with_first(captured.result, self._pinned_result)
        if any(pinned is not None for pinned in self._pinned):
            captured.done.record(captured.stream)
        return captured.result


@dataclass(frozen=True)
class CapturedGraph:
    """A CUDA graph of a function without arguments.

    Args:
        graph: the graph.
        result: the function's result, in memory that each replay overwrites.
        stream: the stream of replays.
        done: event for the end of a replay, not recorded yet.
    """

    graph: torch.cuda.CUDAGraph
    result: Any
    stream: torch.cuda.Stream
    done: torch.cuda.Event


def capture(function: Callable[[], Any], device: torch.device, pool: Any) -> CapturedGraph:
    """Capture a function as `torch.cuda.graph` does, but without emptying caches, as a scan may be waiting.

    Raises:
        RuntimeError: CUDA cannot capture one of the function's operations.
    """
    with torch.cuda.device(device):
        graph, stream = torch.cuda.CUDAGraph(), _capture_stream(torch.cuda.current_device())
        stream.wait_stream(torch.cuda.current_stream())
        with torch.cuda.stream(stream):
            graph.capture_begin(pool=pool, capture_error_mode="thread_local")
            try:
                result = function()
            except BaseException:
                with contextlib.suppress(RuntimeError):  # a consequence of the first error
                    graph.capture_end()
                raise
            graph.capture_end()
        torch.cuda.current_stream().wait_stream(stream)
        return CapturedGraph(graph, result, torch.cuda.current_stream(), torch.cuda.Event())


@functools.cache
def _capture_stream(device: int) -> torch.cuda.Stream:
    """One stream for all captures: libraries keep memory for every stream."""
    return torch.cuda.Stream(device)


def _pool() -> Any:
    return torch.cuda.graph_pool_handle() if torch.cuda.is_available() else object()


def _pinned(shape: Sequence[int], dtype: torch.dtype) -> Tensor:
    return torch.empty(tuple(shape), dtype=dtype, pin_memory=torch.cuda.is_available())


def _first(result: Any) -> Tensor:
    return result[0] if isinstance(result, tuple) else result


def _with_first(result: Any, first: Tensor) -> Any:
    return (first, *result[1:]) if isinstance(result, tuple) else first


def _with_first_on_cpu(result: Any) -> Any:
    return _with_first(result, _first(result).cpu())
