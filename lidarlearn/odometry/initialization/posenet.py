"""PoseNet as an initialization."""

from typing import Protocol, runtime_checkable

import torch
from jaxtyping import Float
from torch import Tensor

from lidarlearn.cuda_graphs import GraphCache, Padding
from lidarlearn.geometry import se3
from lidarlearn.geometry.projection import SphericalProjection
from lidarlearn.odometry.initialization.base import Initialization, InitialMotion
from lidarlearn.odometry.initialization.constant_velocity import ConstantVelocity

_PADDING = Padding()


@runtime_checkable
class RelativePoseNetwork(Protocol):
    """What the initialization needs of a network: relative poses from pairs of vertex maps."""

    @property
    def projection(self) -> SphericalProjection:
        """The projection of its vertex maps."""

    @property
    def device(self) -> torch.device:
        """The device of its parameters."""

    def relative_pose(self, reference: Float[Tensor, "b 3 h w"], target: Float[Tensor, "b 3 h w"]) -> Tensor:
        """`T_ref_new` (b, 4, 4), float64."""


class PoseNetInitialization(Initialization):
    """The motion between the last two scans as estimated by a trained network.

    Args:
        network: a trained network, e.g. `lidarlearn.training.trained_network.load_trained_network(ckpt)`.

    Source: Dellenbach et al. 2021, III-A "Initialization", IV-C.
    """

    def __init__(self, network: RelativePoseNetwork) -> None:
        self._network = network
        self._previous: Tensor | None = None
        self._graphs = GraphCache()

    def predict(self, points: Float[Tensor, "n 3"], last_motion: Float[Tensor, "4 4"]) -> InitialMotion:
        """The network's estimate; the identity for the first scan; constant velocity where it is not finite."""
        project, device = self._network.projection.vertex_map, self._network.device
        vertices = self._graphs(project, points, device=device, padding=_PADDING)[None].clone()
        previous, self._previous = self._previous, vertices
        if previous is None:
            return InitialMotion(se3.identity(), "posenet")
        T_previous_new = self._network.relative_pose(previous, vertices)[0].cpu()
        if not T_previous_new.isfinite().all():
            return ConstantVelocity().predict(points, last_motion)
        return InitialMotion(T_previous_new, "posenet")
