"""A trained network out of its checkpoint, without the machinery that trained it."""

from dataclasses import dataclass, field
from pathlib import Path

import torch
from jaxtyping import Float
from torch import Tensor, nn

from lidarlearn.cuda_graphs import GraphCache
from lidarlearn.geometry import se3
from lidarlearn.geometry.projection import SphericalProjection
from lidarlearn.training.checkpoints import CheckpointError, load_checkpoint
from lidarlearn.training.parts import build

_PREFIX = "model."  # of the network's entries in the state of a PoseNetModule


@dataclass(frozen=True)
class TrainedNetwork:
    """A network ready to predict.

    Args:
        network: in evaluation mode; maps two vertex maps to the six parameters of `se3.from_euler`.
        projection: the image it was trained on.
        device: where it is.
    """

    network: nn.Module
    projection: SphericalProjection
    device: torch.device
    _graphs: GraphCache = field(default_factory=GraphCache, init=False, repr=False, compare=False)

    @torch.no_grad()
    def relative_pose(
        self, reference: Float[Tensor, "batch 3 h w"], target: Float[Tensor, "batch 3 h w"]
    ) -> Float[Tensor, "batch 4 4"]:
        """`T_ref_new`, float64, from two vertex maps [m] made with `projection`."""
        if len(reference) > 1:  # enough work for a GPU to hide the launches of its kernels
            return self._relative_pose(reference, target)
        return self._graphs(self._relative_pose, reference, target, device=self.device).clone()

    def _relative_pose(self, reference: Tensor, target: Tensor) -> Float[Tensor, "batch 4 4"]:
        return se3.from_euler(self.network(reference, target).double())


def load_trained_network(path: Path | str, device: torch.device | str = "cpu") -> TrainedNetwork:
    """Rebuild a network from a checkpoint alone, without running any code of the file.

    Raises:
        CheckpointError: the file is missing, is no checkpoint of this project, or holds more than plain data.
        UntrustedTargetError: it names classes that are not ours.
    """
    checkpoint = load_checkpoint(Path(path), map_location=device)
    parameters = checkpoint["hyper_parameters"]
    network = build(parameters["model"], nn.Module)
    state = {k.removeprefix(_PREFIX): v for k, v in checkpoint["state_dict"].items() if k.startswith(_PREFIX)}
    try:
        network.load_state_dict(state)
    except RuntimeError as error:
        raise CheckpointError(Path(path), f"its weights do not fit its model: {error}") from error
    projection = SphericalProjection(**parameters["trained_on"]["projection"])
    return TrainedNetwork(network.to(device).eval(), projection, torch.device(device))
