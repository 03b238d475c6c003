"""CUDA graphs: what a GPU is asked for again and again is recorded once, and from then on asked for at once.

A scan takes a GPU a thousand small operations, and the CPU longer to ask for each than the GPU to do it.
"""

import contextlib
import functools
import warnings
from collections.abc import Callable, Hashable, Sequence
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor


def are_used_on(device: torch.device) -> bool:
    """Whether there are any on a device. What is recorded asks for no size, and reads no number, of what it computes.

    Where it depends on this how something is computed, it does so for this reason.
    """
    return device.type == "cuda"


@dataclass(frozen=True)
class Padding:
    """Rows behind those of a tensor: few different lengths need few recordings.

    Args:
        value: what stands in them.
        least: the length becomes a multiple of so many, or of more that are a quarter of it at most.
        to_power_of_two: it becomes a power of two.
    """

    value: float = torch.nan
    least: int = 256
    to_power_of_two: bool = False

    def length(self, rows: int) -> int:
        """How many rows become of so many."""
        next_power = 1 << max(rows - 1, 1).bit_length()
        return rows + -rows % (next_power if self.to_power_of_two else max(next_power // 4, self.least))

    def write(self, rows: Tensor, into: Tensor) -> None:
        """Rows, and the value behind them."""
        into[: len(rows)].copy_(rows)
        into[len(rows) :].fill_(self.value)


class Recording:
    """A function of tensors as a CUDA graph.

    Args:
        function: whatever else than its arguments it reads must stay where it is in memory, and numbers of Python's
            what they are.
        inputs: arguments, on the device.
        sent: places on the CPU, pinned, from where those arguments that have one come; None for others.
        answer: a place on the CPU, pinned, for the result or the first of several; None where it stays.
        device: where it computes.
        pool: memory that it shares with others.

    Raises:
        RuntimeError: CUDA does not record what the function does.
    """

    def __init__(
        self,
        function: Callable[..., Any],
        inputs: Sequence[Tensor],
        sent: Sequence[Tensor | None],
        answer: Tensor | None,
        device: torch.device,
        pool: Any,
    ) -> None:
        def run() -> Any:
            for place, value in zip(inputs, sent, strict=True):
                if value is not None:
                    place.copy_(value, non_blocking=True)
            result = function(*inputs)
            if answer is not None:
                answer.copy_(_first(result), non_blocking=True)
            return result

        with torch.cuda.device(device):
            self._graph, self._result = _captured(run, pool)
            self._stream, self._done = torch.cuda.current_stream(), torch.cuda.Event()
        self._is_read, self._is_sent = answer is not None, any(value is not None for value in sent)

    def wait(self) -> None:
        """Until what was sent for the last time has arrived."""
        if self._is_sent and not self._is_read:
            self._done.synchronize()

    def replay(self) -> Any:
        """The result of what stands in the inputs now, in the memory of the last one."""
        self._graph.replay()
        if self._is_read:
            self._stream.synchronize()
        elif self._is_sent:
            self._done.record(self._stream)
        return self._result


def _captured(function: Callable[[], Any], pool: Any) -> tuple[torch.cuda.CUDAGraph, Any]:
    """What `torch.cuda.graph` does, but it empties no caches: a scan may wait for that."""
    graph, stream = torch.cuda.CUDAGraph(), _capture_stream(torch.cuda.current_device())
    stream.wait_stream(torch.cuda.current_stream())
    with torch.cuda.stream(stream):
        graph.capture_begin(pool=pool, capture_error_mode="thread_local")
        try:
            result = function()
        except BaseException:
            with contextlib.suppress(RuntimeError):  # which follows from the other
                graph.capture_end()
            raise
        graph.capture_end()
    torch.cuda.current_stream().wait_stream(stream)
    return graph, result


@functools.cache
def _capture_stream(device: int) -> torch.cuda.Stream:
    """One for all: libraries keep memory for every stream."""
    return torch.cuda.Stream(device)


class Recordings:
    """Calls functions of tensors; on a GPU each is recorded when it comes the second time, and replayed from then on.

    Where there are no CUDA graphs functions are simply called, and so are those of which CUDA does not make one.

    A result is good until any of the functions is called again: the memory of the next one may be the same.
    """

    _MOST = 64  # more than an odometry needs; each keeps some megabytes

    def __init__(self) -> None:
        self._recordings: dict[Hashable, _Prepared] = {}
        self._pool: Any = None

    def forget(self) -> None:
        """Give all memory back, because functions read from elsewhere now."""
        self._recordings.clear()
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
        """The function's result.

        Args:
            function: see `Recording`; one and the same in every call with equal settings.
            inputs: its arguments, on any device; the function gets them on `device`.
            device: where it computes.
            settings: tells this function from others, and from itself with other numbers.
            padding: of the first argument, where functions are recorded.
            keeps_first: whether the first argument, if it is the same tensor as in the last call, holds the same.
            reads_first: whether the result, or the first of several, is wanted on the CPU.
        """
        if not are_used_on(device) or not all(value.numel() for value in inputs):
            result = function(*(value.to(device) for value in inputs))
            return _read(result) if reads_first else result
        shapes = [tuple(value.shape) for value in inputs]
        if padding is not None:
            shapes[0] = (padding.length(len(inputs[0])), *shapes[0][1:])
        key = (settings, device, *shapes, *(value.dtype for value in inputs))
        if key not in self._recordings:
            if len(self._recordings) >= self._MOST:
                self.forget()
            self._pool = self._pool or _pool()
            self._recordings[key] = _Prepared(inputs, shapes, device, self._pool, padding, reads_first)
        return self._recordings[key](function, inputs, keeps_first)


class _Prepared:
    """A function and places for its arguments and its answer: called once as it is, and then recorded.

    Args:
        inputs: the first arguments.
        shapes: of the places.
        device: where the function computes.
        pool: see `Recording`.
        padding: of the first argument.
        reads_first: see `Recordings`.
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
        self._sent = [_pinned(shape, value.dtype) if value.device.type == "cpu" else None for value, shape in both]
        self._device, self._pool, self._padding, self._reads_first = device, pool, padding, reads_first
        self._answer: Tensor | None = None
        self._first: Tensor | None = None
        self._has_come = self._is_refused = False
        self._recording: Recording | None = None

    def __call__(self, function: Callable[..., Any], inputs: Sequence[Tensor], keeps_first: bool) -> Any:
        """The result for these arguments."""
        if self._recording is not None:
            self._recording.wait()
        for i, given in enumerate(inputs):
            if i or not (keeps_first and given is self._first):
                self._write(i, given)
        if self._has_come and self._recording is None and not self._is_refused:
            self._record(function)
        if self._recording is None:
            return self._call(function)
        result = self._recording.replay()
        return result if self._answer is None else _replaced(result, self._answer)

    def _record(self, function: Callable[..., Any]) -> None:
        try:
            self._recording = Recording(function, self._inputs, self._sent, self._answer, self._device, self._pool)
        except RuntimeError as error:
            self._is_refused = True
            reason = str(error).partition("\n")[0]
            warnings.warn(f"{function} is slower than it could be, it cannot be a CUDA graph: {reason}", stacklevel=4)

    def _call(self, function: Callable[..., Any]) -> Any:
        for place, value in zip(self._inputs, self._sent, strict=True):
            if value is not None:
                place.copy_(value)
        result = function(*self._inputs)
        self._has_come = True
        if not self._reads_first:
            return result
        self._answer = _pinned(_first(result).shape, _first(result).dtype)
        return _read(result)

    def _write(self, i: int, given: Tensor) -> None:
        """Into the place of an argument."""
        sent = self._sent[i]
        place = self._inputs[i] if sent is None else sent
        if i == 0:
            self._first = given
        if i == 0 and self._padding is not None:
            self._padding.write(given, into=place)
        else:
            place.copy_(given)


def _pool() -> Any:
    return torch.cuda.graph_pool_handle() if torch.cuda.is_available() else object()


def _pinned(shape: Sequence[int], dtype: torch.dtype) -> Tensor:
    return torch.empty(tuple(shape), dtype=dtype, pin_memory=torch.cuda.is_available())


def _first(result: Any) -> Tensor:
    return result[0] if isinstance(result, tuple) else result


def _replaced(result: Any, first: Tensor) -> Any:
    return (first, *result[1:]) if isinstance(result, tuple) else first


def _read(result: Any) -> Any:
    return _replaced(result, _first(result).cpu())
