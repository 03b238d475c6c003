"""The map of a drive from above."""

import math

import numpy as np
import torch
from jaxtyping import Float
from matplotlib import colormaps
from matplotlib.axes import Axes
from matplotlib.colors import ListedColormap
from matplotlib.image import AxesImage
from matplotlib.patheffects import withStroke
from torch import Tensor

from lidarlearn.evaluation.figure import Figure, disable_formulas, finish
from lidarlearn.geometry.voxels import voxel_cells

_DPI = 150
_SIDE_IN = 8.5  # longer side of the map [inch]
_NARROWEST = 0.45  # least ratio of the shorter to the longer side: straight drives get a margin
_PIXELS = 1300  # most pixels along the longer side: about the resolution of the figure
_CLIPPED = (0.02, 0.98)  # quantiles of the pixels' heights at which the colour scale ends
# Pale ground and dark walls, as on a plan. The palest colours are left out: they vanish on white.
_COLOURS = ListedColormap(colormaps["YlGnBu"](np.linspace(0.2, 1, 256)))


def map_figure(
    title: str,
    points: Float[Tensor, "n 3"],
    pixel_m: float,
    T_estimates: dict[str, Float[Tensor, "m 4 4"]],
    T_true: Float[Tensor, "m 4 4"] | None,
) -> Figure:
    """Bird's-eye view of a map with a colour scale of its heights; arguments as for `draw_map`."""
    lower, upper = points.amin(0)[:2], points.amax(0)[:2]
    narrowest = (_NARROWEST * (upper - lower).max()).clamp(min=1)
    missing = (narrowest - (upper - lower)).clamp(min=0) / 2
    lower, upper = lower - missing, upper + missing
    across, along = (_SIDE_IN * (upper - lower) / (upper - lower).max()).tolist()
    figure = Figure(figsize=(across + 1.6, along + 1.1), dpi=_DPI, layout="compressed")
    axes = figure.add_subplot()
    image = draw_map(axes, points, pixel_m, T_estimates, T_true)
    axes.set(xlim=(float(lower[0]), float(upper[0])), ylim=(float(lower[1]), float(upper[1])))
    figure.suptitle(title, parse_math=False)
    finish(axes, "", "x, forward at the start [m]", "y, left at the start [m]")
    figure.colorbar(image, label="height above the first pose [m]", extend="both", shrink=0.7, aspect=40, pad=0.01)
    return figure


def draw_map(
    axes: Axes,
    points: Float[Tensor, "n 3"],
    pixel_m: float,
    T_estimates: dict[str, Float[Tensor, "m 4 4"]],
    T_true: Float[Tensor, "m 4 4"] | None,
) -> AxesImage:
    """Draw a map from above, coloured by the height of the highest point of each pixel, and trajectories on top.

    Args:
        axes: axes to draw on; x and y get the same scale.
        points: points of the map, in the frame of the first pose [m].
        pixel_m: edge of the pixels [m], usually that of the map's voxels. Large maps get a multiple of it.
        T_estimates: the poses with which the map was built, by method.
        T_true: ground-truth poses, drawn dashed; None if there are none.
    """
    heights, extent = _seen_from_above(points, pixel_m)
    lowest, highest = np.nanquantile(heights, _CLIPPED)
    look = {"cmap": _COLOURS, "vmin": lowest, "vmax": highest, "interpolation": "nearest"}
    image = axes.imshow(heights, extent=extent, origin="lower", zorder=1, **look)  # above the grid
    outlined = [withStroke(linewidth=4, foreground="white")]
    for method, T in T_estimates.items():
        axes.plot(*T[:, :2, 3].mT.numpy(), color="#d55e00", linewidth=2, path_effects=outlined, label=method)
    if T_true is not None:
        axes.plot(*T_true[:, :2, 3].mT.numpy(), color="black", linewidth=1, linestyle="--", label="ground truth")
    disable_formulas(axes.legend(loc="lower right", bbox_to_anchor=(1, 1), ncols=2, frameon=False, borderaxespad=0.2))
    return image


def _seen_from_above(
    points: Float[Tensor, "n 3"], pixel_m: float
) -> tuple[np.ndarray, tuple[float, float, float, float]]:
    """Image of the highest point of each pixel (NaN: no point), and its left, right, lower and upper edge [m]."""
    size = float((points.amax(0) - points.amin(0))[:2].max())
    pixel_m *= max(1, math.ceil(size / (pixel_m * _PIXELS)))
    cells = voxel_cells(points, pixel_m)[:, :2].long()
    first, last = cells.amin(0), cells.amax(0)
    columns, rows = (last - first + 1).tolist()
    place = (cells - first) @ torch.tensor([1, columns])
    heights = torch.full((rows * columns,), -torch.inf).scatter_reduce_(0, place, points[:, 2], "amax")
    left, lower = (first * pixel_m).tolist()
    image = torch.where(heights.isfinite(), heights, torch.nan).view(rows, columns).numpy()
    return image, (left, left + columns * pixel_m, lower, lower + rows * pixel_m)
