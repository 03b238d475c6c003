"""A world of boxes and drives through it, ray cast in a few lines of torch: small genuine input for training."""

import math

import torch
from jaxtyping import Float
from torch import Tensor

from lidarlearn.data.layout import LayoutReport
from lidarlearn.data.sequence import DataSet, Scan, Sequence
from lidarlearn.geometry import se3
from lidarlearn.geometry.projection import SphericalProjection

SMALL = SphericalProjection(height=16, width=96, fov_up_deg=15.0, fov_down_deg=-20.0)

# The first one is seen from inside: a hall with its floor 1.7 m below the sensor's path.
_LOWER = torch.tensor([[-30.0, -12, -1.7], [4, 3, -1.7], [-6, 4, -1.7], [8, -7, -1.7], [-9, -6, -1.7], [14, 5, -1.7]])
_UPPER = torch.tensor([[30.0, 12, 6], [6, 5, 2], [-4, 6, 1], [10, -4, 3], [-7, -4, 2], [15, 6, 3]])


def cast(T_world_lidar: Float[Tensor, "4 4"], projection: SphericalProjection = SMALL) -> Float[Tensor, "n 3"]:
    """Points in the sensor frame, one for the centre of each pixel; noise-free."""
    fov_up, fov_down = math.radians(projection.fov_up_deg), math.radians(projection.fov_down_deg)
    elevation = fov_up - (torch.arange(projection.height) + 0.5) / projection.height * (fov_up - fov_down)
    azimuth = math.pi * (1 - (torch.arange(projection.width) + 0.5) / projection.width * 2)
    e, a = torch.meshgrid(elevation, azimuth, indexing="ij")
    rays = torch.stack([e.cos() * a.cos(), e.cos() * a.sin(), e.sin()], dim=-1).reshape(-1, 3)
    T = T_world_lidar.float()
    directions, origin = rays @ T[:3, :3].mT, T[:3, 3]
    to_lower = (_LOWER - origin)[:, None] / directions
    to_upper = (_UPPER - origin)[:, None] / directions
    entry = torch.minimum(to_lower, to_upper).amax(-1)
    leaving = torch.maximum(to_lower, to_upper).amin(-1)
    hit = (entry < leaving) & (entry > 0)
    hit[0] = False
    ranges = torch.where(hit, entry, torch.inf).amin(0)
    return rays * torch.minimum(ranges, leaving[0])[:, None]


class BoxSequence(Sequence):
    """A drive through the hall, back and forth at a varying speed; scans are computed on access."""

    def __init__(self, name: str, frames: int, truth: bool = True) -> None:
        self.name = name
        time = torch.arange(frames) + 50.0 * int(name)
        speed = 0.4 + 0.3 * torch.sin(time / 3)
        motion = torch.zeros(frames - 1, 6)
        motion[:, 0] = (speed * torch.cos(time / 17).sign())[1:]
        motion[:, 5] = 0.02 * torch.sin(time / 5)[1:]
        self._poses = se3.accumulate(se3.from_euler(motion.double()))
        self.T_world_lidar = self._poses if truth else None
        self.timestamps = 0.1 * torch.arange(frames, dtype=torch.float64)

    def __len__(self) -> int:
        return len(self._poses)

    def scan(self, index: int) -> Scan:
        return Scan(cast(self._poses[index]))

    @property
    def fingerprint(self) -> str:
        return f"boxes {self.name} {len(self)}"


class BoxDrives(DataSet):
    """Sequences "0", "1", ...; those in `without_truth` have no ground truth."""

    def __init__(
        self,
        frames: int = 17,
        train_sequences: tuple[str, ...] = ("0", "1"),
        val_sequences: tuple[str, ...] = ("2",),
        without_truth: tuple[str, ...] = (),
    ) -> None:
        self.title = "boxes"
        self.projection = SMALL
        self.frames = frames
        self.train_sequences, self.val_sequences = tuple(train_sequences), tuple(val_sequences)
        self.test_sequences = ()
        self.without_truth = tuple(without_truth)
        self.max_frames, self.deskew, self.beam_correction_deg = None, False, 0.0

    def sequence(self, name: str) -> BoxSequence:
        return BoxSequence(name, self.frames, truth=name not in self.without_truth)

    def check(self) -> LayoutReport:
        return LayoutReport()
