"""Draw the picture of the README, docs/images/overview.png, from a simulated drive.

It shows the map and trajectory of an odometry, and a scan as PoseNet sees it.
"""

from pathlib import Path

import numpy as np
import torch
from matplotlib import colormaps
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from torch import Tensor

from lidarlearn.evaluation.map_figure import draw_map
from lidarlearn.evaluation.maps import MapSettings, build_map
from lidarlearn.geometry.normals import normal_map
from lidarlearn.geometry.projection import SphericalProjection, activated
from lidarlearn.odometry import Backend, GridSampling, LocalMap, Odometry
from lidarlearn.odometry.initialization import ConstantVelocity
from lidarlearn.registration.association import KdTree
from lidarlearn.simulation.drive import Drive

_PATH = Path(__file__).parent / "images" / "overview.png"
_SHOWN = 40  # the scan shown as an image


def main() -> None:
    """Simulate a drive, register its scans, and draw the picture."""
    drive = Drive("urban", seed=7, frames=220)
    odometry = Odometry(ConstantVelocity(), Backend(GridSampling(), LocalMap(KdTree())))
    poses = torch.stack([odometry.register_scan(scan.points).T_world_lidar for scan in drive])
    figure = Figure(figsize=(11, 6.4), dpi=110, layout="constrained")
    world, ranges, normals = figure.subplots(3, 1, gridspec_kw={"height_ratios": [6, 1, 1]})
    _draw_map(world, drive, poses)
    vertices = SphericalProjection().vertex_map(drive.scan(_SHOWN).points)
    _draw_image(ranges, _range_colours(vertices), "vertex map, coloured by range")
    _draw_image(normals, _normal_colours(vertices), "normal map")
    figure.savefig(_PATH)


def _draw_map(axes: Axes, drive: Drive, poses: Tensor) -> None:
    settings = MapSettings(max_range_m=80)
    points = build_map(drive, poses, settings).points
    draw_map(axes, points, settings.voxel_size_m, {"cv+kd_f2m": poses}, drive.T_world_lidar)
    margin = torch.tensor([75.0, 25.0])
    low, high = poses[:, :2, 3].amin(0) - margin, poses[:, :2, 3].amax(0) + margin
    axes.set(xlim=(low[0], high[0]), ylim=(low[1], high[1]), xlabel="x [m]", ylabel="y [m]")


def _draw_image(axes: Axes, image: np.ndarray, title: str) -> None:
    axes.imshow(image, aspect="auto", interpolation="nearest")
    axes.set_title(title, fontsize=9, loc="left")
    axes.set_axis_off()


def _range_colours(vertices: Tensor) -> np.ndarray:
    ranges = vertices.norm(dim=0)
    shade = (ranges.clamp(3, 60).log() - np.log(3)) / (np.log(60) - np.log(3))
    return np.where(activated(vertices)[..., None], colormaps["turbo_r"](shade.numpy())[..., :3], 1.0)


def _normal_colours(vertices: Tensor) -> np.ndarray:
    normals = normal_map(vertices)
    return np.where((normals != 0).any(dim=0)[..., None], (normals.movedim(0, -1).numpy() + 1) / 2, 1.0)


if __name__ == "__main__":
    main()
