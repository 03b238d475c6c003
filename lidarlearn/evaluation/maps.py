"""The map of a drive: all scans in the frame of the first, one point per voxel, and the map's sharpness."""

import math
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import torch
from jaxtyping import Float, Int
from torch import Tensor

from lidarlearn.data.ply import write_ply
from lidarlearn.data.sequence import Scan, Sequence
from lidarlearn.errors import UserError
from lidarlearn.geometry import se3
from lidarlearn.geometry.normals import covariances_of, fit_planes
from lidarlearn.geometry.ranges import in_range
from lidarlearn.geometry.voxels import VoxelSums, voxel_cells
from lidarlearn.odometry.deskew import deskew

_NEIGHBOURHOOD_M = 0.5  # edge of the cubes in which the map's sharpness is measured
_LEAST_NEIGHBOURS = 10  # fewest points of a cube to which a plane is fitted


@dataclass(frozen=True)
class MapSettings:
    """Which points of the scans go into a map.

    Args:
        voxel_size_m: edge of the voxels, each of which holds one point [m].
        every: use only every n-th scan.
        min_range_m: closer returns are left out, as they show the vehicle itself [m].
        max_range_m: farther returns are left out, as they are sparse and an error of the angle displaces them most [m].

    Raises:
        UserError: no point can meet these settings.
    """

    voxel_size_m: float = 0.2
    every: int = 1
    min_range_m: float = 2.5
    max_range_m: float = 60.0

    def __post_init__(self) -> None:
        if not 0 < self.voxel_size_m < math.inf:
            raise UserError(f"--voxel {self.voxel_size_m:g}: not a size of voxels\n  change: --voxel to more than 0")
        if self.every < 1:
            raise UserError(f"--every {self.every}: no scan is used\n  change: --every to 1 or more")
        if not 0 <= self.min_range_m < self.max_range_m:
            raise UserError(
                f"--min-range {self.min_range_m:g}, --max-range {self.max_range_m:g}: no point is in this range\n"
                "  change: --min-range and --max-range"
            )


@dataclass(frozen=True)
class PointMap:
    """The map of a drive.

    Args:
        points: mean of the measured points in each voxel, in the frame of the first scan [m], float32.
        intensities: mean reflectance in each voxel, in [0, 1]; None if a scan has none.
        mean_plane_variance_m2: see `mean_plane_variance`; None where it is not defined.
    """

    points: Float[Tensor, "n 3"]
    intensities: Float[Tensor, "n"] | None
    mean_plane_variance_m2: float | None

    @property
    def extent_m(self) -> list[float]:
        """Edges of the bounding box along x, y and z [m]."""
        return (self.points.amax(0) - self.points.amin(0)).tolist()

    def write(self, path: Path) -> None:
        """Write a binary .ply file of x, y, z and, if known, intensity, in float32."""
        fields = dict(zip("xyz", self.points.mT.contiguous(), strict=True))
        if self.intensities is not None:
            fields["intensity"] = self.intensities
        path.parent.mkdir(parents=True, exist_ok=True)
        write_ply(path, {name: values.numpy() for name, values in fields.items()})


def build_map(
    sequence: Sequence,
    T_world_lidar: Float[Tensor, "n 4 4"],
    settings: MapSettings,
    deskewed: bool = False,
    advance: Callable[[], None] = lambda: None,
) -> PointMap:
    """Merge the scans of a drive into one map.

    Scans are read one by one, and only voxels are kept, so revisiting a place takes no more memory.

    Args:
        sequence: the scans.
        T_world_lidar: the pose of each scan, from any method.
        settings: which points go into the map.
        deskewed: whether to compensate the motion within each scan, from the poses before and after it.
        advance: called after each scan.

    Raises:
        UserError: the numbers of poses and scans differ, or no point is in range.
    """
    if len(T_world_lidar) != len(sequence):
        raise UserError(
            f"{sequence.name}: {len(T_world_lidar)} poses for {len(sequence)} scans\n"
            "  change: data.max_frames or data.root to what the run had, or run evaluate.py again"
        )
    voxels, neighbourhoods, has_intensities = VoxelSums(5), VoxelSums(10, torch.float64), True
    for index in range(0, len(sequence), settings.every):
        scan = _in_range(sequence.scan(index), settings)
        points = deskew(scan.points, scan.times, _motion(T_world_lidar, index)) if deskewed else scan.points
        points_world = se3.transform(T_world_lidar[index], points.double())
        cells, offsets = _placed(points_world, settings.voxel_size_m)
        has_intensities &= scan.intensities is not None
        intensities = scan.intensities if scan.intensities is not None else torch.zeros(len(points))
        voxels.add(cells, torch.stack([torch.ones(len(points)), *offsets.float().unbind(1), intensities], dim=1))
        cells, offsets = _placed(points_world, _NEIGHBOURHOOD_M)
        neighbourhoods.add(cells, moments(offsets))
        advance()
    cells, sums = voxels.result()
    if not len(cells):
        raise UserError(
            f"{sequence.name}: no point between {settings.min_range_m:g} and {settings.max_range_m:g} m away\n"
            "  change: --min-range and --max-range"
        )
    means = sums[:, 1:] / sums[:, :1]
    points_world = (cells + 0.5).double() * settings.voxel_size_m + means[:, :3]
    _, neighbours = neighbourhoods.result()
    return PointMap(points_world.float(), means[:, 3] if has_intensities else None, mean_plane_variance(neighbours))


def moments(points: Float[Tensor, "n 3"]) -> Float[Tensor, "n 10"]:
    """The moments of each point, to be summed over a neighbourhood: 1, x, y, z, xx, xy, xz, yy, yz, zz."""
    x, y, z = points.unbind(1)
    return torch.stack([torch.ones_like(x), x, y, z, x * x, x * y, x * z, y * y, y * z, z * z], dim=1)


def mean_plane_variance(sums: Float[Tensor, "m 10"]) -> float | None:
    """Thickness of a map's surfaces: mean variance across the plane fitted to each neighbourhood [m^2].

    It needs no ground truth: poses that do not fit together double or blur the walls. Surfaces that are not flat
    increase it under any poses, so it only compares methods on the same scans. The source takes balls around each point
    as neighbourhoods; cubes can be summed scan by scan.

    Args:
        sums: sums of the `moments` of the points of each neighbourhood.

    Returns:
        The mean over all neighbourhoods with enough points; None if there are none.

    Source: Razlaw et al., "Evaluation of registration methods for sparse 3D laser scans", ECMR 2015: MPV.
    """
    sums = sums[sums[:, 0] >= _LEAST_NEIGHBOURS]
    if not len(sums):
        return None
    means = sums[:, 1:] / sums[:, :1]
    return fit_planes(covariances_of(means[:, :3], means[:, 3:])).variances[:, 0].mean().item()


def _in_range(scan: Scan, settings: MapSettings) -> Scan:
    kept = in_range(scan.points, settings.min_range_m, settings.max_range_m)
    times, intensities = (None if column is None else column[kept] for column in (scan.times, scan.intensities))
    return Scan(scan.points[kept], times, intensities)


def _motion(T_world_lidar: Float[Tensor, "n 4 4"], index: int) -> Float[Tensor, "4 4"]:
    """The motion during one scan period: the mean of the motions before and after the scan, if both exist."""
    before, after = max(index - 1, 0), min(index + 1, len(T_world_lidar) - 1)
    T_before_after = se3.inverse(T_world_lidar[before]) @ T_world_lidar[after]
    return se3.exp(se3.log(T_before_after) / max(after - before, 1))


def _placed(points_world: Float[Tensor, "n 3"], voxel_size_m: float) -> tuple[Int[Tensor, "n 3"], Float[Tensor, "n 3"]]:
    """The voxel of each point, and the point relative to its centre: sums of small numbers lose no digits."""
    cells = voxel_cells(points_world, voxel_size_m)
    return cells, points_world - (cells + 0.5).double() * voxel_size_m
