"""Whether the scans of a data set fit into the image configured for its sensor."""

import torch
from jaxtyping import Float
from torch import Tensor

from lidarlearn.geometry.projection import SphericalProjection

_TOLERATED_SHARE = 0.1  # the image of a wrong sensor loses a third; the right one a few returns of the outermost beams


def field_of_view_warning(name: str, points: Float[Tensor, "n 3"], projection: SphericalProjection) -> str | None:
    """A warning if many points of a scan lie above or below the image; None if they fit.

    Args:
        name: of the sequence.
        points: of its first scan [m].
        projection: the configured image.
    """
    points = points[(points != 0).any(dim=1)]
    if not len(points):
        return None
    share = float((projection.pixel_index(points) < 0).float().mean())
    if share <= _TOLERATED_SHARE:
        return None
    elevations = torch.rad2deg(torch.asin(points[:, 2] / points.norm(dim=1))).sort().values
    lowest, highest = (float(elevations[int(quantile * len(points))]) for quantile in (0.005, 0.995))
    up, down = projection.fov_up_deg, projection.fov_down_deg
    return (
        f"{100 * share:.0f} % of the points of {name}'s first scan lie outside the image"
        f" ({up:+g} to {down:+g} deg); they reach from {highest:+.0f} to {lowest:+.0f} deg."
        "\n  change: projection@data.projection=hdl64|hdl32|hdl32_inverted|vlp16|os1_64|os1_64_gen1,"
        " or data.projection.fov_up_deg and data.projection.fov_down_deg"
    )
