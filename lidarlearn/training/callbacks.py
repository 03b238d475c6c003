"""What TensorBoard shows besides curves: images of the input, and trajectories of the validation sequences."""

import numpy as np
import torch
from jaxtyping import Float
from lightning.pytorch import Callback, LightningModule, Trainer
from lightning.pytorch.loggers import TensorBoardLogger
from matplotlib import colormaps
from torch import Tensor
from torch.utils.tensorboard import SummaryWriter

from lidarlearn.evaluation.plots import trajectory_figure
from lidarlearn.geometry.normals import normal_map
from lidarlearn.geometry.projection import activated
from lidarlearn.losses.projective import ProjectiveLoss, reproject
from lidarlearn.training.module import PoseNetModule

_IMAGE_ROWS = 192  # to which images are enlarged, roughly: a scan has few rows


class EventLogger(TensorBoardLogger):
    """TensorBoard's events, directly in the run folder, whose `config.yaml` holds all hyperparameters.

    Args:
        save_dir: the folder.
    """

    def __init__(self, save_dir: str) -> None:
        super().__init__(save_dir, name="", version="", default_hp_metric=False)

    def save(self) -> None:
        """Flush the events; write no hparams.yaml, which would be empty."""
        self.experiment.flush()


class _Drawing(Callback):
    """Draws the results of a validation every few epochs.

    Args:
        every_n_epochs: least number of epochs between two drawings; more if validation runs less often.
    """

    def __init__(self, every_n_epochs: int = 1) -> None:
        self.every_n_epochs = every_n_epochs
        self._last_epoch: int | None = None

    def writer_if_due(self, trainer: Trainer) -> SummaryWriter | None:
        """TensorBoard's writer if a drawing is due; None otherwise, in sanity checks, and in all but one process."""
        writers = [logger.experiment for logger in trainer.loggers if isinstance(logger, TensorBoardLogger)]
        is_due = self._last_epoch is None or trainer.current_epoch - self._last_epoch >= self.every_n_epochs
        if not is_due or trainer.sanity_checking or not trainer.is_global_zero or not writers:
            return None
        self._last_epoch = trainer.current_epoch
        return writers[0]


class InputImages(_Drawing):
    """Images of the first validation pair: range and normals of the reference, and how well the target fits it.

    The normals are the loss's own if it uses any.

    Args:
        every_n_epochs: least number of epochs between two drawings.
        max_range_m: range at the end of the colour scale [m].
        max_residual_m: point-to-plane distance at the end of its colour scale [m].
    """

    def __init__(self, every_n_epochs: int = 5, max_range_m: float = 60.0, max_residual_m: float = 1.0) -> None:
        super().__init__(every_n_epochs)
        self.max_range_m = max_range_m
        self.max_residual_m = max_residual_m

    def on_validation_batch_end(
        self,
        trainer: Trainer,
        pl_module: LightningModule,
        outputs: object,
        batch: dict[str, Tensor],
        batch_idx: int,
        dataloader_idx: int = 0,
    ) -> None:
        """Draw the first pair of the first sequence."""
        writer = None if batch_idx or dataloader_idx else self.writer_if_due(trainer)
        if writer is None:
            return
        assert isinstance(pl_module, PoseNetModule)
        reference, target = batch["reference"][:1], batch["target"][:1]
        aligned = reproject(pl_module.relative_pose(reference, target), target, pl_module.projection)
        loss = pl_module.loss
        normals = loss.normals(reference) if isinstance(loss, ProjectiveLoss) else normal_map(reference)
        images = {
            f"vertex map, range 0 to {self.max_range_m:g} m": range_image(reference[0], self.max_range_m),
            "normal map": normal_image(normals[0]),
            f"point-to-plane distance as predicted, 0 to {self.max_residual_m:g} m": scalar_image(
                ((aligned - reference) * normals).sum(dim=1)[0].abs(),
                (activated(normals) & activated(aligned))[0],
                self.max_residual_m,
            ),
        }
        for title, image in images.items():
            writer.add_image(f"val/{title}", enlarged(image), trainer.current_epoch)


class Trajectories(_Drawing):
    """A figure of each validation sequence: the predicted trajectory over the ground truth.

    Args:
        every_n_epochs: least number of epochs between two drawings.
    """

    def on_validation_end(self, trainer: Trainer, pl_module: LightningModule) -> None:
        """Draw the trajectories that the module has just predicted."""
        writer = self.writer_if_due(trainer)
        if writer is None:
            return
        assert isinstance(pl_module, PoseNetModule)
        for drive in pl_module.predicted_drives:
            title = f"sequence {drive.name} after {trainer.current_epoch + 1} epochs"
            figure = trajectory_figure(title, drive.T_world_lidar_true, {"posenet": drive.T_world_lidar})
            writer.add_figure(f"val/trajectory {drive.name}", figure, trainer.current_epoch)


def range_image(vertex_map: Float[Tensor, "3 h w"], max_range_m: float) -> Float[Tensor, "3 h w"]:
    """Ranges in colour, on a square-root scale that shows near structure; black where no point fell."""
    ranges = vertex_map.norm(dim=0)
    return scalar_image(ranges.sqrt(), activated(vertex_map), max_range_m**0.5)


def normal_image(normals: Float[Tensor, "3 h w"]) -> Float[Tensor, "3 h w"]:
    """Components of unit normals as red, green, blue, from -1 (dark) to 1 (bright); black where undefined."""
    return torch.where(activated(normals), (normals + 1) / 2, 0.0)


def scalar_image(values: Float[Tensor, "h w"], valid: Tensor, largest: float) -> Float[Tensor, "3 h w"]:
    """Values from 0 to `largest` in colour; black where not valid."""
    colours = torch.from_numpy(colormaps["turbo"](np.arange(256))[:, :3]).float()
    index = (values / largest * 255).clamp(0, 255).long().cpu()
    return torch.where(valid.cpu(), colours[index].movedim(-1, 0), 0.0)


def enlarged(image: Float[Tensor, "3 h w"]) -> Float[Tensor, "3 i j"]:
    """The image with each pixel repeated a whole number of times."""
    times = max(1, _IMAGE_ROWS // image.shape[1])
    return image.repeat_interleave(times, dim=1).repeat_interleave(max(1, times // 2), dim=2)
