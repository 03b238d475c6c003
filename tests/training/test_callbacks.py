"""The images that TensorBoard shows."""

import pytest
import torch
from matplotlib.figure import Figure

from lidarlearn.commands.train import train
from lidarlearn.geometry import se3
from lidarlearn.geometry.normals import normal_map
from lidarlearn.training import callbacks
from lidarlearn.training.callbacks import enlarged, normal_image, range_image, scalar_image
from tests.box_world import SMALL, BoxSequence, cast
from tests.training.runs import configured, images, predicted

pytestmark = [
    pytest.mark.usefixtures("small_network"),
    pytest.mark.filterwarnings("ignore::DeprecationWarning:tensorboard"),
]


def test_range_image_is_black_at_empty_pixels_only():
    vertex_map = SMALL.vertex_map(cast(se3.identity()))
    vertex_map[:, :, :20] = 0
    image = range_image(vertex_map, max_range_m=60.0)
    assert image.shape == (3, 16, 96)
    assert (image[:, :, :20] == 0).all() and (image[:, :, 20:].sum(0) > 0).all()
    assert 0 <= image.min() and image.max() <= 1


def test_range_image_colour_depends_on_range_alone():
    near, far = torch.tensor([3.0, 0, 0]), torch.tensor([0.0, 30, 0])
    vertex_map = torch.stack([near, near[[1, 0, 2]], far, far[[1, 0, 2]]], dim=1)[:, None]
    image = range_image(vertex_map, 60.0)[:, 0]
    torch.testing.assert_close(image[:, 0], image[:, 1])
    torch.testing.assert_close(image[:, 2], image[:, 3])
    assert not torch.allclose(image[:, 0], image[:, 2])


def test_normal_image_maps_components_to_rgb():
    up, left = torch.tensor([0.0, 0, 1]), torch.tensor([0.0, 1, 0])
    image = normal_image(torch.stack([up, left, torch.zeros(3)], dim=1)[:, None])[:, 0].T
    assert image.tolist() == [[0.5, 0.5, 1], [0.5, 1, 0.5], [0, 0, 0]]
    assert normal_image(normal_map(SMALL.vertex_map(cast(se3.identity())))).amin() >= 0


def test_scalar_image_clamps_to_largest_value():
    values, valid = torch.tensor([[0.0, 1.0, 5.0, 5.0]]), torch.tensor([[True, True, True, False]])
    image = scalar_image(values, valid, largest=1.0)[:, 0].T
    assert image[1].tolist() == image[2].tolist() != image[0].tolist()
    assert image[3].tolist() == [0, 0, 0]


def test_enlarged_repeats_pixels():
    image = torch.rand(3, 16, 4)
    large = enlarged(image)
    assert large.shape == (3, 192, 24)
    torch.testing.assert_close(large[:, ::12, ::6], image)


def test_trajectories_are_those_of_the_current_network(tmp_path, monkeypatch):
    drawn = {}

    def figure(title, T_true, T_estimates):
        drawn[title] = T_estimates["posenet"]
        return Figure()

    monkeypatch.setattr(callbacks, "trajectory_figure", figure)
    often = ("trainer.max_epochs=2", "trainer.num_sanity_val_steps=-1")
    train(configured(tmp_path, *often, draws=True, frames=9), data_name="boxes")
    first, last = drawn.pop("sequence 2 after 1 epochs"), drawn.pop("sequence 2 after 2 epochs")
    expected = predicted(tmp_path / "checkpoints" / "last.ckpt", BoxSequence("2", 9))
    torch.testing.assert_close(last, expected, rtol=1e-4, atol=1e-4)
    assert not drawn and (first - last).abs().max() > 1e-2


def test_drawings_follow_every_n_epochs_of_validation(tmp_path):
    seldom = [f"callbacks.{name}.every_n_epochs=3" for name in ("images", "trajectories")]
    often = ("trainer.max_epochs=6", "trainer.check_val_every_n_epoch=2", "+trainer.limit_train_batches=1")
    train(configured(tmp_path, *seldom, *often, draws=True, frames=5), data_name="boxes")
    epochs = images(tmp_path)
    assert len(epochs) == 4 and all(drawn == [1, 5] for drawn in epochs.values()), epochs
