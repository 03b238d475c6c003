"""PoseNet: a residual network that regresses the relative pose of two scans from their vertex maps."""

from typing import Literal, get_args

import torch
import torchvision
from jaxtyping import Float
from torch import Tensor, nn
from torch.nn.functional import pad

from lidarlearn.geometry.projection import activated

Backbone = Literal["resnet18", "resnet34", "resnet50"]
Encoding = Literal["maps", "difference"]

INITIAL_HEAD_STD = 1e-3  # an untrained network predicts almost no motion, for which projective association works


class PoseNet(nn.Module):
    """Relative pose of a new scan in a reference scan, from the two vertex maps stacked in the channel dimension.

    The six outputs are the translation [m] and the Euler angles [rad] of `T_ref_new`, see `se3.from_euler`.

    Args:
        backbone: one of torchvision's residual networks, with random weights.
        encoding: "maps" stacks the two vertex maps as in the paper. "difference" replaces the target by its difference
            from the reference: motion moves points tens of metres away by decimetres, and a network that gets only the
            two positions spends most of a short training on learning to subtract them (simulated town, 3 epochs: an
            error of 54 % of the motion instead of 20 %).
        input_scale_m: coordinates are divided by this, so that inputs are around one [m].
        difference_scale_m: length at which a difference reaches half of its bound [m]; longer ones are due to a change
            of surface rather than to motion. Has no effect on "maps".
        rotation_scale: factor of the rotation head. Angles between scans are an order of magnitude smaller than
            translations in metres; without the factor, early steps rotate scans out of each other's view.
        wrap_columns: pad convolutions with the columns beyond the seam instead of zeros.

    Source: Dellenbach et al. 2021, III-B "Deep LiDAR Odometries": ResNet-18, Euler angles.
    """

    output_scale: Tensor

    def __init__(
        self,
        backbone: Backbone = "resnet18",
        encoding: Encoding = "difference",
        input_scale_m: float = 20.0,
        difference_scale_m: float = 2.0,
        rotation_scale: float = 0.1,
        wrap_columns: bool = True,
    ) -> None:
        super().__init__()
        if encoding not in get_args(Encoding):
            raise ValueError(f"encoding is one of {', '.join(get_args(Encoding))}, got {encoding!r}")
        self.encoding = encoding
        self.input_scale_m = input_scale_m
        self.difference_scale_m = difference_scale_m
        network = torchvision.models.get_model(backbone, weights=None, num_classes=6)
        network.conv1 = nn.Conv2d(6, network.conv1.out_channels, kernel_size=7, stride=2, padding=3, bias=False)
        nn.init.normal_(network.fc.weight, std=INITIAL_HEAD_STD)
        nn.init.zeros_(network.fc.bias)
        if wrap_columns:
            _wrap_columns(network)
        self.network = network
        self.register_buffer("output_scale", torch.tensor([1.0] * 3 + [rotation_scale] * 3), persistent=False)

    def forward(
        self, reference: Float[Tensor, "batch 3 h w"], target: Float[Tensor, "batch 3 h w"]
    ) -> Float[Tensor, "batch 6"]:
        """Parameters (x, y, z [m], roll, pitch, yaw [rad]) of `T_ref_new`.

        Args:
            reference: vertex map of the earlier scan [m], zeros where no point fell.
            target: vertex map of the new scan [m], likewise, each in its own sensor frame.
        """
        first = reference / self.input_scale_m
        if self.encoding == "maps":
            second = target / self.input_scale_m
        else:
            second = bounded_difference(reference, target, self.difference_scale_m)
        return self.network(torch.cat([first, second], dim=1)) * self.output_scale


def bounded_difference(
    reference: Float[Tensor, "batch 3 h w"], target: Float[Tensor, "batch 3 h w"], scale_m: float
) -> Float[Tensor, "batch 3 h w"]:
    """Target minus reference per pixel as d / (scale + |d|), which is shorter than one; zero where either is empty."""
    both = (activated(reference) & activated(target))[:, None]
    d = torch.where(both, target - reference, 0.0)
    return d / (scale_m + d.norm(dim=1, keepdim=True))


class ColumnWrappedConv2d(nn.Conv2d):
    """A convolution whose columns wrap at the image's seam; rows are padded with zeros as usual."""

    def forward(self, input: Float[Tensor, "batch c h w"]) -> Float[Tensor, "batch d i j"]:
        """Convolve after padding the columns circularly."""
        rows, columns = int(self.padding[0]), int(self.padding[1])
        wrapped = pad(input, (columns, columns, 0, 0), mode="circular")
        return nn.functional.conv2d(wrapped, self.weight, self.bias, self.stride, (rows, 0), self.dilation, self.groups)


def _wrap_columns(network: nn.Module) -> None:
    """Replace all padded convolutions by ones that wrap columns; parameters keep their names and values."""
    for name, child in network.named_children():
        if isinstance(child, nn.Conv2d) and int(child.padding[1]) > 0:
            wrapped = ColumnWrappedConv2d(
                child.in_channels,
                child.out_channels,
                kernel_size=(child.kernel_size[0], child.kernel_size[1]),
                stride=(child.stride[0], child.stride[1]),
                padding=(int(child.padding[0]), int(child.padding[1])),
                dilation=(child.dilation[0], child.dilation[1]),
                groups=child.groups,
                bias=child.bias is not None,
            )
            wrapped.load_state_dict(child.state_dict())
            setattr(network, name, wrapped)
        else:
            _wrap_columns(child)
