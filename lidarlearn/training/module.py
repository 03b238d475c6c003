"""What supervised and unsupervised training of PoseNet share."""

from abc import abstractmethod
from pathlib import Path
from typing import Any

import torch
from jaxtyping import Float
from lightning.pytorch import LightningModule
from lightning.pytorch.utilities.types import OptimizerLRSchedulerConfig
from torch import Tensor, nn
from torch.optim import Optimizer
from torch.optim.lr_scheduler import LRScheduler

from lidarlearn.data.pairs import Pair
from lidarlearn.data.sequence import Sequence
from lidarlearn.geometry import se3
from lidarlearn.geometry.projection import SphericalProjection
from lidarlearn.losses.result import LossResult
from lidarlearn.training.checkpoints import load_checkpoint
from lidarlearn.training.drives import PredictedDrive, drive_errors, mean_errors, predicted_drive
from lidarlearn.training.parts import build


class PoseNetModule(LightningModule):
    """Trains a network that regresses relative poses; subclasses define the loss.

    All arguments are plain dicts. The first four name the class to build in `_target_`: a checkpoint holds them as its
    hyperparameters and rebuilds its own model, see `load_from_checkpoint`.

    Args:
        model: the network.
        loss: what it minimizes.
        optimizer: over the parameters of both.
        scheduler: of the optimizer's learning rate, see `configure_optimizers`.
        trained_on: provenance of the checkpoint, for people, for `evaluate.py` and for resuming: "data" (config of the
            data set, without its root), "data_name", "train_sequences" (names), "loss", "git", "lidarlearn",
            "projection" (height, width, fov_up_deg, fov_down_deg of the network's image), and "settings" (see
            `lidarlearn.commands.resume`).
    """

    def __init__(
        self,
        model: dict[str, Any],
        loss: dict[str, Any],
        optimizer: dict[str, Any],
        scheduler: dict[str, Any],
        trained_on: dict[str, Any],
    ) -> None:
        super().__init__()
        self.save_hyperparameters(logger=False)
        self.projection = SphericalProjection(**trained_on["projection"])
        self.model = build(model, nn.Module)
        self.loss = build(loss, nn.Module)
        self.predicted_drives: list[PredictedDrive] = []
        self._predictions: list[list[tuple[Tensor, Tensor]]] = []
        self._val_losses: list[LossResult] = []

    @classmethod
    def load_from_checkpoint(  # type: ignore[override]  # the file holds all other arguments
        cls, checkpoint_path: str | Path, map_location: torch.device | str = "cpu"
    ) -> "PoseNetModule":
        """The trained module in evaluation mode, rebuilt from the file alone; runs no code of the file.

        Raises:
            CheckpointError: the file is missing, is not a checkpoint of this project, or holds more than plain data.
            UntrustedTargetError: it names classes of other packages.
        """
        checkpoint = load_checkpoint(Path(checkpoint_path), map_location)
        module = build({**checkpoint["hyper_parameters"], "_target_": checkpoint["module"]}, PoseNetModule)
        module.load_state_dict(checkpoint["state_dict"])
        return module.to(map_location).eval()

    def on_save_checkpoint(self, checkpoint: dict[str, Any]) -> None:
        """Add what Lightning leaves out: the class, and the state of the random number generator."""
        checkpoint["module"] = f"{type(self).__module__}.{type(self).__qualname__}"
        checkpoint["random_state"] = torch.get_rng_state()

    def on_load_checkpoint(self, checkpoint: dict[str, Any]) -> None:
        """Restore the random number generator, so that a resumed training sees the batches of an unbroken one."""
        if "random_state" in checkpoint:
            torch.set_rng_state(checkpoint["random_state"].cpu())

    def on_train_start(self) -> None:
        """Give each process random numbers of its own: all start with the same seed or checkpoint."""
        if self.global_rank > 0:
            torch.manual_seed(int(torch.randint(2**62, ())) + self.global_rank)

    @abstractmethod
    def compute_loss(self, parameters: Float[Tensor, "batch 6"], batch: Pair) -> LossResult:
        """The loss of the network's estimates on a batch of pairs."""

    def forward(
        self, reference: Float[Tensor, "batch 3 h w"], target: Float[Tensor, "batch 3 h w"]
    ) -> Float[Tensor, "batch 6"]:
        """Translation [m] and Euler angles [rad] of `T_ref_new` from two vertex maps [m], in float32."""
        return self.model(reference, target).float()

    @torch.no_grad()
    def relative_pose(
        self, reference: Float[Tensor, "batch 3 h w"], target: Float[Tensor, "batch 3 h w"]
    ) -> Float[Tensor, "batch 4 4"]:
        """`T_ref_new`, float64, from two vertex maps [m] made with `projection`."""
        return se3.from_euler(self(reference, target).double())

    def training_step(self, batch: Pair, batch_idx: int) -> Tensor:
        """Loss of a batch; logs it and its parts."""
        result = self._loss(self(batch["reference"], batch["target"]), batch)
        values = {f"train/{name}": value for name, value in result.parts.items()}
        # averaged over all processes, so that a curve does not depend on their number
        self.log_dict(
            {"train/loss": result.loss, **values}, batch_size=len(batch["reference"]), on_epoch=True, sync_dist=True
        )
        return result.loss

    def on_validation_epoch_start(self) -> None:
        """Discard the predictions of the last epoch."""
        self._predictions = [[] for _ in self.val_sequences]
        self._val_losses = []

    def validation_step(self, batch: Pair, batch_idx: int, dataloader_idx: int = 0) -> None:
        """Predict the motions of a batch of one sequence."""
        parameters = self(batch["reference"], batch["target"])
        self._val_losses.append(self._loss(parameters, batch))
        self._predictions[dataloader_idx].append((torch.as_tensor(batch["index"]), parameters.detach()))

    def on_validation_epoch_end(self) -> None:
        """Accumulate the predictions to trajectories, score them, and log the error that selects the best checkpoint.

        `val/error` is the average translation error [%]. For drives under 100 m it is the mean relative translation
        error [m]; without ground truth it is how badly the scans are aligned, see `losses.projective.misfit`.
        """
        self.predicted_drives = [
            predicted_drive(sequence, *self._gather_predictions(predictions))
            for sequence, predictions in zip(self.val_sequences, self._predictions, strict=True)
        ]
        means = mean_errors([e for e in map(drive_errors, self.predicted_drives) if e is not None])
        loss = self._mean_over_processes([result.loss for result in self._val_losses])
        misfit = self._mean_over_processes([result.parts.get("misfit", result.loss) for result in self._val_losses])
        error = means.get("avg_translation_error_percent", means.get("mean_relative_translation_error_m", misfit))
        errors = means or {"misfit": misfit}
        self.log_dict({f"val/{name}": value for name, value in errors.items()}, rank_zero_only=True)
        # logged in every process, each with the same value: all of them take part in saving checkpoints
        self.log_dict({"val/loss": loss, "val/error": error})

    @property
    def val_sequences(self) -> list[Sequence]:
        """The validation sequences, in the order of their loaders."""
        datamodule = self.trainer.datamodule  # type: ignore[attr-defined]  # Lightning sets it without declaring it
        return datamodule.val_sequences

    def configure_optimizers(self) -> OptimizerLRSchedulerConfig:
        """Optimizer over the network and the loss (which may have weights to learn), and its learning-rate schedule.

        A schedule that takes `total_steps` is updated every step, others every epoch.
        """
        optimizer = build(self.hparams["optimizer"], Optimizer, params=self.parameters())
        schedule = dict(self.hparams["scheduler"])
        interval = "step" if "total_steps" in schedule else "epoch"
        if interval == "step" and schedule["total_steps"] is None:
            schedule["total_steps"] = int(self.trainer.estimated_stepping_batches)
        scheduler = build(schedule, LRScheduler, optimizer=optimizer)
        return {"optimizer": optimizer, "lr_scheduler": {"scheduler": scheduler, "interval": interval}}

    def _loss(self, parameters: Float[Tensor, "batch 6"], batch: Pair) -> LossResult:
        """The loss in full precision: in 16 bits, coordinates of 50 m are resolved to a quarter of a metre at best."""
        with torch.autocast(self.device.type, enabled=False):
            return self.compute_loss(parameters, batch)

    def _gather_predictions(self, predictions: list[tuple[Tensor, Tensor]]) -> tuple[Tensor, Tensor]:
        """Indices and parameters of a sequence's predictions, from all processes."""
        if not predictions:
            return torch.zeros(0, dtype=torch.long), torch.zeros(0, 6)
        indices = self._gather(torch.cat([index for index, _ in predictions]))
        parameters = self._gather(torch.cat([values for _, values in predictions]))
        return indices.reshape(-1), parameters.reshape(-1, 6)

    def _mean_over_processes(self, values: list[Tensor]) -> float:
        return float(self._gather(torch.stack(values)).mean()) if values else 0.0

    def _gather(self, values: Tensor) -> Tensor:
        """The values of all processes, stacked if there are several; the sampler gives each the same number."""
        gathered = self.all_gather(values)
        assert isinstance(gathered, Tensor)
        return gathered
