"""Basins of convergence: how far off an initial pose may be for a registration to find the right pose.

The right pose is the one at which a registration from the true pose ends. On real drives, the true poses themselves are
less accurate than registrations: against a map of KITTI 04 built with them, registrations end 0.1 m away from them.
"""

import math
from collections.abc import Callable, Collection, Mapping
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from lidarlearn.data.sequence import Sequence
from lidarlearn.errors import UserError
from lidarlearn.evaluation.figure import Figure
from lidarlearn.evaluation.plots import Panel, curves_figure
from lidarlearn.evaluation.tables import Table
from lidarlearn.geometry import se3
from lidarlearn.geometry.ranges import in_range
from lidarlearn.odometry.backend import Backend

_AT_ONCE = 8  # number of initial poses registered together; bounds the memory


@dataclass(frozen=True)
class Probe:
    """The initial poses to try, and the criterion of success.

    Args:
        offsets_m: errors of the initial position, each in several horizontal directions [m].
        angles_deg: errors of the initial yaw, each to both sides [deg].
        directions: number of directions for each offset.
        every: only every n-th scan is tried; the others only extend the map.
        min_range_m: closer returns are dropped [m].
        max_range_m: farther returns are dropped [m].
        success_m: a registration succeeds if it ends within this distance [m]...
        success_deg: ...and this angle [deg] of where it ends from the true pose.
    """

    offsets_m: Collection[float] = (0.25, 0.5, 0.75, 1.0, 1.5, 2.0, 2.5, 3.0)
    angles_deg: Collection[float] = (2.0, 4.0, 6.0, 8.0, 12.0, 16.0, 20.0, 30.0)
    directions: int = 6
    every: int = 20
    min_range_m: float = 2.5
    max_range_m: float = 100.0
    success_m: float = 0.1
    success_deg: float = 0.5


@dataclass(frozen=True)
class Basin:
    """The share of registrations that succeed.

    Args:
        scans: number of scans that were tried.
        by_offset_m: share by initial error of the position [m].
        by_angle_deg: share by initial error of the yaw [deg].
        from_truth_m: mean distance from the true pose at which registrations end that start from it [m].
        from_truth_deg: the corresponding angle [deg].
    """

    scans: int
    by_offset_m: Mapping[float, float]
    by_angle_deg: Mapping[float, float]
    from_truth_m: float
    from_truth_deg: float


def convergence_basin(
    backend: Backend,
    sequence: Sequence,
    probe: Probe,
    device: torch.device | str = "cpu",
    advance: Callable[[], None] = lambda: None,
) -> Basin:
    """Register scans from wrong initial poses, against a map of all earlier scans at their true poses.

    Args:
        backend: a new backend.
        sequence: a sequence with ground truth.
        probe: the initial poses to try.
        device: device of the backend's map.
        advance: called after each scan.

    Raises:
        UserError: the sequence has no ground truth, or too few scans.
    """
    T_true = sequence.T_world_lidar
    if T_true is None:
        raise UserError(f"sequence {sequence.name} has no ground truth to start from: choose another")
    if len(sequence) <= probe.every:
        raise UserError(f"sequence {sequence.name} has {len(sequence)} scans: set probe.every to fewer")
    T_error = torch.cat([se3.identity(1), _shifts(probe), _turns(probe)])
    successes, from_truth = torch.zeros(len(T_error) - 1), torch.zeros(2, dtype=torch.float64)
    scans = 0
    for i, scan in enumerate(sequence):
        near_enough = in_range(scan.points, probe.min_range_m, probe.max_range_m)
        sampled = backend.sampling.sample(scan.points[near_enough].to(device))
        if i and i % probe.every == 0:
            normals = backend.normals(sampled.points, sampled.queries)
            queries = sampled.points[sampled.queries]
            T_end = _registered(backend, queries, normals, T_true[i] @ T_error)
            off_m, off_deg = _distances(T_end[1:], T_end[0])
            successes += (off_m < probe.success_m) & (off_deg < probe.success_deg)
            from_truth += torch.stack(_distances(T_end[0], T_true[i]))
            scans += 1
        backend.local_map.update(sampled.points, T_true[i])
        advance()
    shares = (successes / scans).split([len(probe.offsets_m) * probe.directions, len(probe.angles_deg) * 2])
    by_offset = shares[0].view(-1, probe.directions).mean(1).tolist()
    by_angle = shares[1].view(-1, 2).mean(1).tolist()
    return Basin(
        scans,
        dict(zip(probe.offsets_m, by_offset, strict=True)),
        dict(zip(probe.angles_deg, by_angle, strict=True)),
        *(from_truth / scans).tolist(),
    )


def basin_tables(basins: Mapping[str, Basin]) -> list[Table]:
    """Success rates, and the accuracy of registrations from the true pose; one row per backend."""
    by_unit: list[tuple[str, str, dict[str, Mapping[float, float]]]] = [
        ("offset of the position [m]", " m", {name: b.by_offset_m for name, b in basins.items()}),
        ("error of the yaw [deg]", " deg", {name: b.by_angle_deg for name, b in basins.items()}),
    ]
    tables = []
    for what, unit, shares in by_unit:
        steps = list(next(iter(shares.values())))
        rows = [(name, *(f"{100 * by_step[step]:.0f}" for step in steps)) for name, by_step in shares.items()]
        columns = ("registration", *(f"{step:g}{unit}" for step in steps))
        tables.append(Table(f"Registrations that succeed [%] by initial {what}", columns, tuple(rows)))
    ends = tuple((name, f"{b.from_truth_m:.3f}", f"{b.from_truth_deg:.3f}") for name, b in basins.items())
    note = "Succeed: end where a registration from the true pose ends."
    columns = ("registration", "distance [m]", "angle [deg]")
    return [
        *tables,
        Table("How far from the true pose registrations end that start there", columns, ends, notes=(note,)),
    ]


def basin_figure(title: str, basins: Mapping[str, Basin]) -> Figure:
    """Success rate over the initial error, one curve per backend."""

    def percent(shares: Mapping[float, float]) -> dict[float, float]:
        return {step: 100 * share for step, share in shares.items()}

    what = "registrations that succeed [%]"
    offsets = {name: percent(basin.by_offset_m) for name, basin in basins.items()}
    angles = {name: percent(basin.by_angle_deg) for name, basin in basins.items()}
    panels = [
        Panel("initial offset of the position [m]", what, offsets),
        Panel("initial error of the yaw [deg]", what, angles),
    ]
    return curves_figure(title, panels)


def _registered(
    backend: Backend, points: Tensor, normals: Tensor | None, T_initial: Float[Tensor, "h 4 4"]
) -> Float[Tensor, "h 4 4"]:
    """The poses at which registrations from the initial poses end."""
    ends = [
        backend.registration.register(
            points, backend.local_map.association, T_some, backend.max_search_distance_m, normals
        ).T_world_lidar
        for T_some in T_initial.split(_AT_ONCE)
    ]
    return torch.cat(ends)


def _distances(
    T: Float[Tensor, "*h 4 4"], T_other: Float[Tensor, "4 4"]
) -> tuple[Float[Tensor, "*h"], Float[Tensor, "*h"]]:
    """Distances [m] and angles [deg] of poses from another pose."""
    xi = se3.log(se3.inverse(T_other) @ T)
    return xi[..., :3].norm(dim=-1), xi[..., 3:].norm(dim=-1).rad2deg()


def _shifts(probe: Probe) -> Float[Tensor, "h 4 4"]:
    bearing = torch.arange(probe.directions, dtype=torch.float64) * (2 * math.pi / probe.directions)
    unit = torch.stack([bearing.cos(), bearing.sin()], dim=1)
    parameters = torch.zeros(len(probe.offsets_m), probe.directions, 6, dtype=torch.float64)
    parameters[..., :2] = torch.tensor(probe.offsets_m, dtype=torch.float64)[:, None, None] * unit
    return se3.from_euler(parameters.flatten(0, 1))


def _turns(probe: Probe) -> Float[Tensor, "h 4 4"]:
    angles = torch.tensor(probe.angles_deg, dtype=torch.float64).deg2rad()
    parameters = torch.zeros(len(angles), 2, 6, dtype=torch.float64)
    parameters[..., 5] = torch.stack([angles, -angles], dim=1)
    return se3.from_euler(parameters.flatten(0, 1))
