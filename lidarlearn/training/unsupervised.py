"""Training from scans alone."""

from collections.abc import Callable
from importlib.util import find_spec
from typing import Any

import torch
from jaxtyping import Float
from lightning.pytorch.utilities import rank_zero_warn
from torch import Tensor

from lidarlearn.data.pairs import Pair
from lidarlearn.losses.projective import ProjectiveLoss
from lidarlearn.losses.result import LossResult
from lidarlearn.training.module import PoseNetModule

MIN_ACTIVATED_SHARE = 0.02
"""Share of used pixels below which a training warns; it is about 0.4 for HDL-64 scans."""


class UnsupervisedModule(PoseNetModule):
    """PoseNet trained by how well its estimates align the scans.

    Args:
        model: see `PoseNetModule`.
        loss: a `ProjectiveLoss`.
        optimizer: see `PoseNetModule`.
        scheduler: see `PoseNetModule`.
        trained_on: see `PoseNetModule`.
        compile_loss: whether to compile the training loss, which fuses its hundreds of small operations over all
            pixels into a few; "auto" compiles on a GPU for which torch has a compiler.

    Source: Dellenbach et al. 2021, III-B "Unsupervised training".
    """

    def __init__(
        self,
        model: dict[str, Any],
        loss: dict[str, Any],
        optimizer: dict[str, Any],
        scheduler: dict[str, Any],
        trained_on: dict[str, Any],
        compile_loss: bool | str = "auto",
    ) -> None:
        super().__init__(model, loss, optimizer, scheduler, trained_on)
        if compile_loss not in (True, False, "auto"):
            raise ValueError(f"compile_loss is true, false or auto, got {compile_loss!r}")
        self.compile_loss = compile_loss
        self._training_loss: Callable[..., LossResult] | None = None
        self._has_warned = False

    def on_train_epoch_end(self) -> None:
        """Warn if the estimates have diverged until the scans no longer overlap, which the loss would not show."""
        share = self.trainer.callback_metrics.get("train/activated_share_epoch", torch.tensor(1.0))
        if share < MIN_ACTIVATED_SHARE and not self._has_warned:
            self._has_warned = True
            rate = self.trainer.optimizers[0].defaults["lr"]
            rank_zero_warn(
                f"in epoch {self.current_epoch + 1} only {100 * float(share):.1f} % of the pixels held a point of both "
                "scans and a normal: the estimated motions are so far off that the network cannot recover, however "
                f"small the loss\n  change: a lower optimizer.lr than {rate:g}"
            )

    def compute_loss(self, parameters: Float[Tensor, "batch 6"], batch: Pair) -> LossResult:
        """Point-to-plane alignment of the target with the reference."""
        inputs = (parameters, batch["reference"], batch["target"], self.projection)
        if not self.training:  # batch sizes vary in validation, and the loss would be compiled for each of them
            return self.loss(*inputs)
        is_first = self._training_loss is None
        if self._training_loss is None:
            self._training_loss = compiled(self.loss, *inputs) if self._compiles(parameters) else self.loss.forward
        result = self._training_loss(*inputs)
        if is_first and self.global_step == 0:
            self._warn_if_few_activated(float(result.parts["activated_share"]))
        return result

    def _warn_if_few_activated(self, share: float) -> None:
        if share >= MIN_ACTIVATED_SHARE:
            return
        self._has_warned = True
        p = self.projection
        rank_zero_warn(
            f"only {100 * share:.1f} % of the {p.height}x{p.width} pixels hold a point of both scans and a normal, too "
            f"few to learn from. Do the scans fill an image of this size and field of view ({p.fov_up_deg:g} to "
            f"{p.fov_down_deg:g} deg)?\n  change: datamodule.height, datamodule.width or data.projection"
        )

    def _compiles(self, parameters: Tensor) -> bool:
        if self.compile_loss == "auto":
            return parameters.is_cuda and find_spec("triton") is not None
        return bool(self.compile_loss)


def compiled(loss: ProjectiveLoss, parameters: Float[Tensor, "batch 6"], *others: Any) -> Callable[..., LossResult]:
    """The forward pass of a loss, compiled for inputs of these sizes; uncompiled if that fails.

    Both passes are compiled here: if the backward pass failed during training, that step would be lost.

    Args:
        loss: is not changed.
        parameters: an example of its first argument.
        others: examples of its other arguments.
    """
    forward = torch.compile(loss.forward, fullgraph=True, dynamic=False)
    try:
        forward(parameters.detach().requires_grad_(), *others).loss.backward()
    except Exception as error:  # a missing or broken compiler or driver can raise anything
        rank_zero_warn(
            f"the loss could not be compiled, training continues without: {type(error).__name__}: "
            f"{str(error).strip().partition(chr(10))[0]}\n  change: module.compile_loss=false, or repair the compiler"
        )
        return loss.forward
    return forward
