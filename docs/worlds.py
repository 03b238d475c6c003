"""Draw pictures of the simulated worlds, docs/images/world_<preset>.png: bird's-eye views and range images."""

from pathlib import Path

import matplotlib

matplotlib.use("Agg")

import matplotlib.pyplot as plt
import numpy as np
import torch

from lidarlearn.geometry.projection import SphericalProjection
from lidarlearn.geometry.se3 import transform
from lidarlearn.simulation.drive import Drive
from lidarlearn.simulation.worlds import PRESETS

_FRAMES = 200


def picture(world: str, seed: int, path: Path) -> None:
    """Draw a drive through a world from above, coloured by height, and two of its scans as range images."""
    drive = Drive(world, seed=seed, frames=_FRAMES)
    assert drive.T_world_lidar is not None
    elevations = drive.sensor.elevations_deg
    projection = SphericalProjection(len(elevations), 720, elevations[0] + 0.4, elevations[-1] - 0.4)
    figure = plt.figure(figsize=(12, 9), layout="constrained")
    above, *images = figure.subplots(3, 1, gridspec_kw={"height_ratios": [5, 1, 1]})
    for i in range(0, _FRAMES, 8):
        points = drive.scan(i).points
        points = points[points.norm(dim=1) < 60]
        x, y, z = transform(drive.T_world_lidar[i], points[::3]).T.numpy()
        dots = above.scatter(x, y, s=0.15, c=z, cmap="viridis", vmin=-4, vmax=6, linewidths=0, rasterized=True)
    path_world = drive.T_world_lidar[:, :2, 3].numpy()
    above.plot(*path_world.T, color="red", label="sensor")
    above.set(aspect="equal", xlabel="x [m]", ylabel="y [m]", title=f"{world}: {_FRAMES} scans of {drive.sensor.name}")
    above.legend(loc="upper right")
    figure.colorbar(dots, ax=above, label="height above the sensor's start [m]")
    for image, i in zip(images, (_FRAMES // 3, _FRAMES - 20), strict=True):
        ranges = projection.vertex_map(drive.scan(i).points).norm(dim=0).numpy()
        shown = image.imshow(
            np.where(ranges > 0, ranges, np.nan), aspect="auto", cmap="turbo", norm="log", vmin=3, vmax=90
        )
        image.set(title=f"scan {i}", xlabel="column [px]", ylabel="row [px]")
    figure.colorbar(shown, ax=images, label="range [m]")
    figure.savefig(path, dpi=80)
    plt.close(figure)


def main() -> None:
    """Draw all worlds."""
    torch.set_num_threads(1)
    folder = Path(__file__).parent / "images"
    folder.mkdir(exist_ok=True)
    for world in PRESETS:
        picture(world, 0, folder / f"world_{world}.png")


if __name__ == "__main__":
    main()
