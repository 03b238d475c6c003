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

LEAST_ACTIVATED_SHARE = 0.02
"""Share of used pixels below which a training warns; HDL-64 scans have about 0.4."""


class UnsupervisedModule(PoseNetModule):
    """PoseNet trained by how well its estimates align the scans themselves.

    Args:
        model: see `PoseNetModule`, as for all that follow.
        loss: one of the projective ones.
        optimizer: takes the parameters.
        scheduler: takes the optimizer.
        trained_on: what to tell about a checkpoint.
        compile_loss: whether the loss of training is compiled, which fuses its hundreds of small steps over all pixels
            into a few; "auto" does so on a GPU for which torch has a compiler.

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
        """Warn where the estimates have come so far off that scans no longer overlap: no loss would show it."""
        share = self.trainer.callback_metrics.get("train/activated_share_epoch", torch.tensor(1.0))
        if share < LEAST_ACTIVATED_SHARE and not self._has_warned:
            self._has_warned = True
            rate = self.trainer.optimizers[0].defaults["lr"]
            rank_zero_warn(
                f"in epoch {self.current_epoch + 1} only {100 * float(share):.1f} % of the pixels held a point of both "
                "scans and a normal: the estimated motions are so far off that nothing can be learned from them any "
                f"more, however small the loss\n  change: a lower optimizer.lr than {rate:g}"
            )

    def compute_loss(self, parameters: Float[Tensor, "batch 6"], batch: Pair) -> LossResult:
        """Point-to-plane alignment of the target with the reference."""
        inputs = (parameters, batch["reference"], batch["target"], self.projection)
        if not self.training:  # batches of any size, for each of which it would be compiled anew
            return self.loss(*inputs)
        is_first = self._training_loss is None
        if self._training_loss is None:
            self._training_loss = compiled(self.loss, *inputs) if self._shall_compile(parameters) else self.loss.forward
        result = self._training_loss(*inputs)
        if is_first and self.global_step == 0 and result.parts["activated_share"] < LEAST_ACTIVATED_SHARE:
            self._has_warned = True
            p = self.projection
            rank_zero_warn(
                f"only {100 * float(result.parts['activated_share']):.1f} % of the {p.height}x{p.width} pixels hold a "
                f"point of both scans and a normal: nothing can be learned from so few. Do scans fill an image of this "
                f"size and field of view ({p.fov_up_deg:g} to {p.fov_down_deg:g} deg)? Change datamodule.height, "
                "datamodule.width or data.projection"
            )
        return result

    def _shall_compile(self, parameters: Tensor) -> bool:
        if self.compile_loss == "auto":
            return parameters.is_cuda and find_spec("triton") is not None
        return bool(self.compile_loss)


def compiled(loss: ProjectiveLoss, parameters: Float[Tensor, "batch 6"], *others: Any) -> Callable[..., LossResult]:
    """A loss compiled for inputs of this size, or as it is where that fails.

    Both passes are tried at once: a backward pass that does not compile would show when the step cannot be saved.

    Args:
        loss: stays as it is.
        parameters: an example of its first argument.
        others: of its other ones.
    """
    forward = torch.compile(loss.forward, fullgraph=True, dynamic=False)
    try:
        forward(parameters.detach().requires_grad_(), *others).loss.backward()
    except Exception as error:  # compilers, drivers and the lack of them raise what they like
        rank_zero_warn(
            f"the loss could not be compiled, training goes on without: {type(error).__name__}: "
            f"{str(error).strip().partition(chr(10))[0]}\n  change: module.compile_loss=false, or mend the compiler"
        )
        return loss.forward
    return forward
