"""The images that TensorBoard shows."""

import torch

from lidarlearn.geometry import se3
from lidarlearn.geometry.normals import normal_map
from lidarlearn.training.callbacks import enlarged, normal_image, range_image, scalar_image
from tests.box_world import SMALL, cast


def test_empty_pixels_are_black_and_others_are_not():
    vertex_map = SMALL.vertex_map(cast(se3.identity()))
    vertex_map[:, :, :20] = 0
    image = range_image(vertex_map, max_range_m=60.0)
    assert image.shape == (3, 16, 96)
    assert (image[:, :, :20] == 0).all() and (image[:, :, 20:].sum(0) > 0).all()
    assert 0 <= image.min() and image.max() <= 1


def test_a_range_has_one_colour_whatever_its_direction():
    near, far = torch.tensor([3.0, 0, 0]), torch.tensor([0.0, 30, 0])
    vertex_map = torch.stack([near, near[[1, 0, 2]], far, far[[1, 0, 2]]], dim=1)[:, None]
    image = range_image(vertex_map, 60.0)[:, 0]
    torch.testing.assert_close(image[:, 0], image[:, 1])
    torch.testing.assert_close(image[:, 2], image[:, 3])
    assert not torch.allclose(image[:, 0], image[:, 2])


def test_normals_as_colours():
    up, left = torch.tensor([0.0, 0, 1]), torch.tensor([0.0, 1, 0])
    image = normal_image(torch.stack([up, left, torch.zeros(3)], dim=1)[:, None])[:, 0].T
    assert image.tolist() == [[0.5, 0.5, 1], [0.5, 1, 0.5], [0, 0, 0]]
    assert normal_image(normal_map(SMALL.vertex_map(cast(se3.identity())))).amin() >= 0


def test_values_beyond_the_scale_take_its_end():
    values, valid = torch.tensor([[0.0, 1.0, 5.0, 5.0]]), torch.tensor([[True, True, True, False]])
    image = scalar_image(values, valid, largest=1.0)[:, 0].T
    assert image[1].tolist() == image[2].tolist() != image[0].tolist()
    assert image[3].tolist() == [0, 0, 0]


def test_enlarging_repeats_pixels():
    image = torch.rand(3, 16, 4)
    large = enlarged(image)
    assert large.shape == (3, 192, 24)
    torch.testing.assert_close(large[:, ::12, ::6], image)
