"""Checks of what a reader returns, before any work on it begins: not every reader is part of this package."""

from collections.abc import Iterable

import torch
from torch import Tensor

from lidarlearn.errors import UserError


def require_poses(name: str, T_world_lidar: object, count: int) -> None:
    """Raise a UserError unless a sequence has a finite float64 pose for each of its scans, or none at all."""
    if T_world_lidar is None:
        return
    what, meaning = f"{name}: T_world_lidar is", "one pose a scan, or None without ground truth"
    poses = _require(what, T_world_lidar, (count, 4, 4), torch.float64, meaning)
    _require_finite(f"{name}: T_world_lidar", poses, "pose")


def require_timestamps(name: str, timestamps: object, count: int) -> None:
    """Raise a UserError unless a sequence has a finite time for each of its scans, or none at all."""
    if timestamps is not None:
        times = _require(f"{name}: timestamps is", timestamps, (count,), None, "one time [s] a scan, or None")
        _require_finite(f"{name}: timestamps", times[:, None], "time")


def require_points(name: str, points: object, times: object) -> None:
    """Raise a UserError unless the points of the first scan are float32 x y z, with a time for each of them or none."""
    what = f"{name}: in its first scan,"
    cloud = _require(f"{what} points is", points, (None, 3), torch.float32, "x y z [m] of each point, nothing else")
    if times is not None:
        _require(f"{what} times is", times, (len(cloud),), None, "one time a point, or None")


def _require(
    what: str, value: object, shape: tuple[int | None, ...], dtype: torch.dtype | None, meaning: str
) -> Tensor:
    """The value, which must be a tensor of that shape and type; None stands for any length or type."""
    if isinstance(value, Tensor) and dtype in (None, value.dtype) and value.dim() == len(shape):
        if all(wanted in (None, there) for wanted, there in zip(shape, value.shape, strict=True)):
            return value
    wanted = f"{_in_words('tensor', dtype)} of {_in_brackets(shape)}"
    raise UserError(f"{what} a {_seen(value)}, not a {wanted}.\n  change: its reader, to give {meaning}")


def _require_finite(what: str, values: Tensor, kind: str) -> None:
    """Check values whose first axis is that of the scans."""
    wrong = ~values.isfinite().flatten(1).all(dim=1)
    if bool(wrong.any()):
        raise UserError(
            f"{what} holds values that are not finite in {int(wrong.sum())} of its {len(values)} {kind}s, first in that"
            f" of scan {int(wrong.int().argmax())}.\n  change: its reader, to leave out scans without a {kind}"
        )


def _seen(value: object) -> str:
    kind = "tensor" if isinstance(value, Tensor) else f"{type(value).__module__}.{type(value).__qualname__}"
    described = _in_words(kind.removeprefix("builtins."), getattr(value, "dtype", None))
    shape = getattr(value, "shape", None)
    return described if shape is None else f"{described} of {_in_brackets(shape)}"


def _in_words(kind: str, dtype: object) -> str:
    return kind if dtype is None else f"{str(dtype).removeprefix('torch.')} {kind}"


def _in_brackets(shape: Iterable[int | None]) -> str:
    return f"({', '.join('n' if length is None else str(length) for length in shape)})"
