"""A second device on machines without a GPU: it computes on the CPU but, like a GPU, refuses tensors of the CPU.

It shows that all tensors are on the right device, and counts the kernels and transfers that a GPU would need.
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
_TO_CPU = {"_local_scalar_dense", "equal"}
_WAITS = {"nonzero", "_unique2"}  # the size of the result must be known
_VIEWS = {"alias", "detach", "diagonal", "expand", "permute", "select", "slice", "split", "squeeze", "t", "transpose",
          "unbind", "unsqueeze", "view"}  # fmt: skip


class DeviceTensor(Tensor):
    """A tensor of the pretended device."""

    inner: Tensor

    @staticmethod
    def __new__(cls, inner: Tensor) -> "DeviceTensor":
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
    """Runs all operations, and counts those of the device.

    Attributes:
        launches: operations on it other than views.
        transfers: copies to and from it, and sizes that the CPU waits for.
    """

    launches = 0
    transfers = 0

    def __torch_dispatch__(self, func: Any, types: Any, args: tuple = (), kwargs: dict | None = None) -> Any:
        """Run an operation on the tensors within."""
        kwargs, name = dict(kwargs or {}), func.overloadpacket.__name__
        operands = [leaf for leaf in tree_leaves((args, kwargs)) if isinstance(leaf, Tensor)]
        on_device = [operand for operand in operands if isinstance(operand, DeviceTensor)]
        on_cpu = [operand for operand in operands if not isinstance(operand, DeviceTensor) and operand.dim()]
        may_mix = name in _COPIES or (name in _INDEXES and isinstance(args[0], DeviceTensor))  # as on a GPU
        if on_device and on_cpu and not may_mix:
            raise RuntimeError(f"{func} takes tensors of two devices")
        to_device = bool(on_device) and name not in _TO_CPU
        if kwargs.get("device") is not None:
            to_device = torch.device(kwargs["device"]).type == NAME
            kwargs["device"] = torch.device("cpu")
        if name == "copy_":
            to_device = isinstance(args[0], DeviceTensor)
        is_mask = name in _INDEXES and any(operand.dtype == torch.bool for operand in operands[1:])
        self._count(name, bool(on_device), to_device, bool(on_cpu), waits=is_mask or name in _WAITS)
        wrappers = {id(tensor.inner): tensor for tensor in on_device}
        result = func(*tree_map_only(DeviceTensor, _inner, args), **tree_map_only(DeviceTensor, _inner, kwargs))
        if not to_device:
            return result
        return tree_map_only(Tensor, lambda t: wrappers[id(t)] if id(t) in wrappers else DeviceTensor(t), result)

    def _count(self, name: str, from_device: bool, to_device: bool, from_cpu: bool, waits: bool) -> None:
        is_copy = name in _COPIES and (from_device != to_device or from_cpu)
        if (from_device and (waits or name in _TO_CPU)) or is_copy:
            self.transfers += 1
        elif (from_device or to_device) and name not in _VIEWS:
            self.launches += 1


def _inner(tensor: DeviceTensor) -> Tensor:
    return tensor.inner


@contextlib.contextmanager
def pretended() -> Iterator[PretendDevice]:
    """A process can do so once, and has the device until its end."""
    backend_registration._setup_privateuseone_for_python_backend(NAME)
    with PretendDevice() as mode:
        yield mode
