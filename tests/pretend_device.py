"""A device beside the CPU on any machine: it computes on the CPU, but takes no operand from there, as a GPU would not.

It shows that nothing is left on the wrong device, and how many kernels and transfers a GPU would be asked for.
"""

import contextlib
from collections.abc import Callable, Iterator
from typing import Any

import torch
from torch import Tensor
from torch.utils import backend_registration
from torch.utils._python_dispatch import TorchDispatchMode
from torch.utils._pytree import tree_leaves, tree_map_only

NAME = "pretend"
IS_SUPPORTED = hasattr(backend_registration, "_setup_privateuseone_for_python_backend")  # in recent torch
_COPIES, _INDEXES = {"_to_copy", "copy_"}, {"index", "index_put_"}
_TO_THE_CPU = {"_local_scalar_dense", "equal"}
_WAITS = {"nonzero", "_unique2"}  # the size of the result must be known
_VIEWS = {"alias", "detach", "diagonal", "expand", "permute", "select", "slice", "split", "squeeze", "t", "transpose",
          "unbind", "unsqueeze", "view"}  # fmt: skip


class Elsewhere(Tensor):
    """A tensor of the pretended device."""

    inner: Tensor

    @staticmethod
    def __new__(cls, inner: Tensor) -> "Elsewhere":
        """Wrap a tensor of the CPU."""
        size, strides, offset = inner.size(), inner.stride(), inner.storage_offset()
        wrapper = torch.Tensor._make_wrapper_subclass(
            cls, size, strides=strides, storage_offset=offset, dtype=inner.dtype, device=torch.device(NAME, 0)
        )
        wrapper.inner = inner
        return wrapper

    @classmethod
    def __torch_dispatch__(cls, func: Callable, types: Any, args: tuple = (), kwargs: dict | None = None) -> Any:
        """Only reached outside of the mode."""
        raise RuntimeError(f"{func} of a tensor of the pretended device, outside of `pretended()`")


class PretendDevice(TorchDispatchMode):
    """Runs everything; counts what the device would be asked for.

    Args (counted):
        launches: operations on it that are no views.
        transfers: copies to and from it, and sizes that the CPU waits for.
    """

    launches = 0
    transfers = 0

    def __torch_dispatch__(self, func: Any, types: Any, args: tuple = (), kwargs: dict | None = None) -> Any:
        """Run an operation on the tensors within."""
        kwargs, name = dict(kwargs or {}), func.overloadpacket.__name__
        operands = [leaf for leaf in tree_leaves((args, kwargs)) if isinstance(leaf, Tensor)]
        there = [operand for operand in operands if isinstance(operand, Elsewhere)]
        strangers = [operand for operand in operands if not isinstance(operand, Elsewhere) and operand.dim()]
        may_mix = name in _COPIES or (name in _INDEXES and isinstance(args[0], Elsewhere))  # as on a GPU
        if there and strangers and not may_mix:
            raise RuntimeError(f"{func} takes tensors of two devices")
        is_there = bool(there) and name not in _TO_THE_CPU
        if kwargs.get("device") is not None:
            is_there = torch.device(kwargs["device"]).type == NAME
            kwargs["device"] = torch.device("cpu")
        if name == "copy_":
            is_there = isinstance(args[0], Elsewhere)
        is_mask = name in _INDEXES and any(operand.dtype == torch.bool for operand in operands[1:])
        self._count(name, bool(there), is_there, bool(strangers), waits=is_mask or name in _WAITS)
        wrappers = {id(tensor.inner): tensor for tensor in there}
        result = func(*tree_map_only(Elsewhere, _inner, args), **tree_map_only(Elsewhere, _inner, kwargs))
        if not is_there:
            return result
        return tree_map_only(Tensor, lambda t: wrappers[id(t)] if id(t) in wrappers else Elsewhere(t), result)

    def _count(self, name: str, was_there: bool, is_there: bool, has_strangers: bool, waits: bool) -> None:
        is_copy = name in _COPIES and (was_there != is_there or has_strangers)
        if (was_there and (waits or name in _TO_THE_CPU)) or is_copy:
            self.transfers += 1
        elif (was_there or is_there) and name not in _VIEWS:
            self.launches += 1


def _inner(tensor: Elsewhere) -> Tensor:
    return tensor.inner


@contextlib.contextmanager
def pretended() -> Iterator[PretendDevice]:
    """A process can do so once, and has the device until its end."""
    backend_registration._setup_privateuseone_for_python_backend(NAME)
    with PretendDevice() as mode:
        yield mode
