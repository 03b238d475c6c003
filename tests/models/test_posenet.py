"""PoseNet: its input, its output, and the seam of the image."""

import pytest
import torch
from torch import nn

from lidarlearn.geometry import se3
from lidarlearn.models.posenet import ColumnWrappedConv2d, PoseNet, bounded_difference
from tests.box_world import SMALL, cast


@pytest.fixture(scope="module")
def vertex_map():
    return SMALL.vertex_map(cast(se3.identity()))[None]


@pytest.fixture(scope="module")
def network():
    """The default network, for tests that change nothing in it."""
    return PoseNet().eval()


@pytest.mark.parametrize("batch", [1, 3])
@pytest.mark.parametrize("size", [(16, 96), (32, 90), (64, 45)], ids=["16x96", "32x90", "64x45"])
def test_output_has_six_parameters_for_any_image_size(network, batch, size):
    maps = torch.randn(batch, 3, *size)
    assert network(maps, maps).shape == (batch, 6)


def test_untrained_network_predicts_almost_no_motion(vertex_map):
    torch.manual_seed(0)
    parameters = PoseNet()(vertex_map.expand(4, -1, -1, -1), vertex_map.expand(4, -1, -1, -1))
    assert parameters[:, :3].abs().max() < 0.3
    assert parameters[:, 3:].abs().max() < 0.03


def test_output_depends_on_order_of_maps(network, vertex_map):
    other = vertex_map.roll(3, dims=-1)
    assert not torch.allclose(network(vertex_map, other), network(other, vertex_map))


def test_rotation_scale_multiplies_rotation_outputs(vertex_map):
    torch.manual_seed(0)
    plain = PoseNet(rotation_scale=1.0).eval()
    scaled = PoseNet(rotation_scale=0.1).eval()
    scaled.load_state_dict(plain.state_dict())
    a, b = plain(vertex_map, vertex_map), scaled(vertex_map, vertex_map)
    torch.testing.assert_close(b[:, :3], a[:, :3])
    torch.testing.assert_close(b[:, 3:], 0.1 * a[:, 3:])


@pytest.mark.parametrize("encoding", ["maps", "difference"])
def test_output_depends_on_ratio_of_coordinates_to_scales(encoding, vertex_map):
    near = PoseNet(encoding=encoding, input_scale_m=10.0, difference_scale_m=1.0).eval()
    far = PoseNet(encoding=encoding, input_scale_m=20.0, difference_scale_m=2.0).eval()
    far.load_state_dict(near.state_dict())
    torch.testing.assert_close(far(2 * vertex_map, 2 * vertex_map), near(vertex_map, vertex_map))


def test_bounded_difference_matches_closed_form():
    reference = torch.tensor([[10.0, 10, 0, 5], [0, 0, 0, 5], [0, 0, 0, 5]])[None, :, None]
    target = torch.tensor([[12.0, 110, 7, 0], [0, 0, 0, 0], [0, 0, 0, 0]])[None, :, None]
    difference = bounded_difference(reference, target, scale_m=2.0)
    torch.testing.assert_close(difference[0, :, 0], torch.tensor([[0.5, 100 / 102, 0, 0], [0.0] * 4, [0.0] * 4]))


@pytest.mark.parametrize("backbone", ["resnet18", "resnet34", "resnet50"])
def test_every_backbone_predicts_six_parameters(backbone, vertex_map):
    assert PoseNet(backbone=backbone).eval()(vertex_map, vertex_map).shape == (1, 6)


def test_wrapped_convolution_commutes_with_rotating_columns():
    convolution = ColumnWrappedConv2d(2, 3, kernel_size=3, padding=1)
    image = torch.randn(1, 2, 5, 8)
    torch.testing.assert_close(convolution(image.roll(3, -1)), convolution(image).roll(3, -1))


def test_wrapped_convolution_equals_zero_padding_off_the_seam():
    wrapped = ColumnWrappedConv2d(2, 3, kernel_size=3, padding=1)
    plain = nn.Conv2d(2, 3, kernel_size=3, padding=1)
    plain.load_state_dict(wrapped.state_dict())
    image = torch.randn(1, 2, 5, 8)
    torch.testing.assert_close(wrapped(image)[..., 1:-1], plain(image)[..., 1:-1])


def test_wrap_columns_replaces_all_padded_convolutions():
    plain, wrapped = PoseNet(wrap_columns=False), PoseNet(wrap_columns=True)
    assert plain.state_dict().keys() == wrapped.state_dict().keys()
    padded = [m for m in wrapped.modules() if isinstance(m, nn.Conv2d) and m.padding[1] > 0]
    assert len(padded) == 17 and all(isinstance(m, ColumnWrappedConv2d) for m in padded)
