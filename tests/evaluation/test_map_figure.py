import numpy as np
import pytest
import torch

from lidarlearn.evaluation.map_figure import map_figure


def picture(points, T, T_true=None, pixel_m=0.5, name="m"):
    figure = map_figure(name, points, pixel_m, {name: T}, T_true)
    axes = figure.axes[0]
    return figure, axes, axes.images[0]


def test_map_figure_places_heights(make_drive):
    points = torch.tensor([[0.1, 0.1, 1.0], [0.2, 0.2, 7.0], [9.9, 4.9, 2.0]])
    figure, axes, image = picture(points, make_drive(5), make_drive(5))
    heights = np.ma.filled(image.get_array(), np.nan)
    assert image.get_extent() == [0, 10, 0, 5] and heights.shape == (10, 20)
    assert heights[0, 0] == 7 and heights[-1, -1] == 2 and np.isnan(heights).sum() == 198
    assert axes.get_aspect() == 1 and "[m]" in axes.get_xlabel() and "[m]" in axes.get_ylabel()
    assert [text.get_text() for text in axes.get_legend().get_texts()] == ["m", "ground truth"]
    assert axes.lines[1].get_linestyle() == "--" and "[m]" in figure.axes[1].get_ylabel()


def test_map_figure_accepts_any_name(make_drive):
    figure, _, _ = picture(torch.ones(1, 3), make_drive(5), name="测试 a$b_{c$d")
    figure.draw_without_rendering()


def test_map_figure_limits_image_size(make_drive):
    corners = torch.tensor([[0.0, 0, 0], [5000, 3000, 1]])
    _, _, image = picture(corners, make_drive(5), pixel_m=0.2)
    assert max(image.get_array().shape) <= 1301


@pytest.mark.parametrize("points", [torch.ones(1, 3), torch.tensor([[0.0, 0, 0], [0, 3000, 1]])], ids=["point", "line"])
def test_map_figure_widens_narrow_maps(make_drive, points):
    figure, axes, _ = picture(points, make_drive(5))
    width, height = (upper - lower for lower, upper in (axes.get_xlim(), axes.get_ylim()))
    assert 0.4 < width / height <= 1
    figure.draw_without_rendering()
