"""Figures of an evaluation. Each function returns a Figure, to be written to a file or to TensorBoard.

Pyplot is not used: it would keep every figure of a training open. Figures need no display.
"""

import math
import re
from collections.abc import Callable, Collection, Iterator, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from matplotlib.axes import Axes
from torch import Tensor

from lidarlearn.data.sequence import Sequence
from lidarlearn.evaluation.figure import Figure, finish, legend_beside
from lidarlearn.evaluation.score import Score, pool_by_length
from lidarlearn.geometry import se3
from lidarlearn.metrics.failures import MAX_ROTATION_DEG, MAX_TRANSLATION_M
from lidarlearn.metrics.kitti import SegmentAverage
from lidarlearn.metrics.relative import relative_errors, speeds

Poses = Float[Tensor, "n 4 4"]

_DPI = 120
_TRUTH = "#4d4d4d"
# Okabe and Ito's palette, distinguishable with any colour vision; once it is used up, the line style changes.
_COLOURS = ("#0072b2", "#d55e00", "#009e73", "#cc79a7", "#56b4e9", "#e69f00")
_STYLES = ("-", "--", ":", "-.")
_KMH = 3.6
_LEAST_ERROR = 1e-6  # smallest error on a logarithmic axis [m] or [deg], which cannot show 0; below it is rounding


def trajectory_figure(title: str, T_true: Poses | None, T_estimates: Mapping[str, Poses]) -> Figure:
    """Bird's-eye view of trajectories, all from the same start, with the same scale in both directions.

    Args:
        title: what is shown, e.g. the name of the sequence.
        T_true: ground-truth poses of the LiDAR; None if there are none.
        T_estimates: estimated poses of the LiDAR, by method.
    """
    truth = None if T_true is None else _bird_eye(T_true)
    paths = {method: _bird_eye(T_world) for method, T_world in T_estimates.items()}
    (left, bottom), (right, top) = _view(list(paths.values()), truth).tolist()
    figure = Figure(figsize=(9, 7 * (top - bottom) / (right - left) + 0.5), dpi=_DPI, layout="constrained")
    axes = figure.add_subplot()
    if truth is not None:
        axes.plot(*truth.mT.numpy(), color=_TRUTH, linewidth=4, alpha=0.45, label="ground truth")
    for i, (method, path) in enumerate(paths.items()):
        axes.plot(*path.mT.numpy(), linewidth=1.5, label=method, **_line(i))
    axes.plot(0, 0, marker="o", markersize=7, color="black", linestyle="none", label="start", zorder=5)
    axes.set(xlim=(left, right), ylim=(bottom, top), aspect="equal")
    legend_beside(figure, axes)
    finish(axes, title, "x, forward at the start [m]", "y, left at the start [m]")
    figure.draw_without_rendering()  # settles the aspect, which the next layout needs to make room for the labels
    return figure


def drift_figure(title: str, averages: Mapping[str, Mapping[int, SegmentAverage]]) -> Figure:
    """KITTI's translation and rotation errors over the length of the segments.

    Args:
        title: what is shown.
        averages: mean errors by segment length [m], by method.
    """

    def curves(value: Callable[[SegmentAverage], float]) -> dict[str, dict[float, float]]:
        return {m: {float(n): value(average) for n, average in lengths.items()} for m, lengths in averages.items()}

    x = "segment length [m]"
    translation = Panel(x, "translation error [%]", curves(lambda average: average.translation_percent))
    rotation = Panel(x, "rotation error [deg/100 m]", curves(lambda average: average.rotation_deg_per_100m))
    return curves_figure(title, [translation, rotation])


@dataclass(frozen=True)
class Panel:
    """Curves in one pair of axes.

    Args:
        x: label of the x axis.
        y: label of the y axis.
        curves: values of y by x, by the name of the curve.
    """

    x: str
    y: str
    curves: Mapping[str, Mapping[float, float]]


def curves_figure(title: str, panels: list[Panel]) -> Figure:
    """Panels side by side, with one legend for all of them.

    The markers are rings, the largest those of the first curve, so that curves with the same values all show.
    """
    figure = Figure(figsize=(10, 4), dpi=_DPI, layout="constrained")
    row = figure.subplots(1, len(panels), squeeze=False)[0]
    for k, (axes, panel) in enumerate(zip(row, panels, strict=True)):
        sizes = np.linspace(min(4 * len(panel.curves), 14), 4, len(panel.curves))
        for i, (name, curve) in enumerate(panel.curves.items()):
            style = {"marker": "o", "markersize": sizes[i], "fillstyle": "none", "clip_on": False}
            axes.plot(list(curve), list(curve.values()), label=name, **style, **_line(i))
        axes.set_ylim(bottom=0)
        finish(axes, title if k == 0 else "", panel.x, panel.y)
    legend_beside(figure, row[0])
    return figure


def speed_figure(title: str, true_kmh: Float[Tensor, "n"], estimated_kmh: Mapping[str, Float[Tensor, "_"]]) -> Figure:
    """Distribution of the speed, according to the ground truth and to the estimates.

    Args:
        title: what is shown.
        true_kmh: true speeds between scans [km/h]; empty without ground truth.
        estimated_kmh: estimated speeds between scans [km/h], by method.

    Source: Dellenbach et al. 2021, IV-B, the figure on the distribution of the speed.
    """
    figure = Figure(figsize=(9, 4), dpi=_DPI, layout="constrained")
    axes = figure.add_subplot()
    everything = torch.cat([torch.zeros(0, dtype=torch.float64), *estimated_kmh.values()])
    edges = _speed_edges(true_kmh, everything)
    if len(true_kmh):
        _histogram(axes, true_kmh, edges, color=_TRUTH, alpha=0.35, label="ground truth")
    for i, (method, kmh) in enumerate(estimated_kmh.items()):
        _histogram(axes, kmh, edges, histtype="step", linewidth=1.5, label=method, **_line(i))
    axes.set_xlim(edges[0], edges[-1])
    legend_beside(figure, axes)
    beyond = " (the last bin holds all beyond)" if len(everything) and float(everything.max()) > edges[-1] else ""
    finish(axes, title, f"speed [km/h]{beyond}", f"share of scans [%] per {edges[1] - edges[0]:g} km/h")
    return figure


def frame_error_figure(title: str, T_true: Poses, T_estimates: Mapping[str, Poses]) -> Figure:
    """Error of each motion between consecutive scans, on a logarithmic scale, with the limits of a failure.

    Errors below 1e-6 m or deg are drawn at this value.

    Args:
        title: what is shown.
        T_true: ground-truth poses.
        T_estimates: estimated poses by method, as many as true ones.
    """
    figure = Figure(figsize=(10, 6), dpi=_DPI, layout="constrained")
    upper, lower = figure.subplots(2, 1, sharex=True)
    for i, (method, T_world) in enumerate(T_estimates.items()):
        errors = relative_errors(T_world, T_true)
        frames = np.arange(1, len(errors.translation) + 1)
        style: dict[str, Any] = {"linewidth": 0.6, "label": method, **_line(i)}
        upper.plot(frames, errors.translation.clamp(min=_LEAST_ERROR).cpu(), **style)
        lower.plot(frames, errors.rotation.rad2deg().clamp(min=_LEAST_ERROR).cpu(), **style)
    for axes, limit in ((upper, MAX_TRANSLATION_M), (lower, MAX_ROTATION_DEG)):
        axes.axhline(limit, color=_TRUTH, linewidth=1, linestyle=(0, (6, 3)), label="failure")
        axes.set_yscale("log")
    finish(upper, title, "", "translation error [m]")
    finish(lower, "", "scan", "rotation error [deg]")
    legend_beside(figure, upper)
    return figure


def figures(
    sequences: Mapping[str, Sequence],
    T_world_lidar: Mapping[str, Mapping[str, Poses]],
    scores: list[Score],
    groups: Mapping[str, Collection[str]] | None = None,
) -> Iterator[tuple[str, Figure]]:
    """Yield all figures of an evaluation with their file names.

    Args:
        sequences: sequences by name.
        T_world_lidar: estimated poses of the LiDAR, by method and sequence.
        scores: scores of the same methods and sequences.
        groups: names of sequences by a common heading; each group gets its own distribution of speeds.
    """
    for name, sequence in sequences.items():
        estimates = {method: poses[name] for method, poses in T_world_lidar.items() if name in poses}
        if not estimates:
            continue  # an error ended the evaluation before this sequence
        yield f"trajectories_{name}", trajectory_figure(f"sequence {name}", sequence.T_world_lidar, estimates)
        if sequence.T_world_lidar is not None and len(sequence) > 1:
            yield f"frame_errors_{name}", frame_error_figure(f"sequence {name}", sequence.T_world_lidar, estimates)
    drifts = {method: pool_by_length([row for row in scores if row.method == method]) for method in T_world_lidar}
    drifts = {method: by_length for method, by_length in drifts.items() if by_length}
    over = f"{len(sequences)} sequences" if len(sequences) > 3 else "sequence " + ", ".join(sequences)
    if drifts:
        yield "error_over_distance", drift_figure(over, drifts)
    for heading, names in {over: list(sequences), **(groups or {})}.items():
        chosen = {name: sequence for name, sequence in sequences.items() if name in names}
        true_kmh = _all_speeds(chosen, {n: s.T_world_lidar for n, s in chosen.items() if s.T_world_lidar is not None})
        estimated_kmh = {method: _all_speeds(chosen, poses) for method, poses in T_world_lidar.items()}
        if any(len(kmh) for kmh in (true_kmh, *estimated_kmh.values())):
            suffix = "" if heading == over else "_" + re.sub(r"[^\w.-]+", "_", heading).strip("_")
            yield f"speed_distribution{suffix}", speed_figure(heading, true_kmh, estimated_kmh)


def _line(index: int) -> dict[str, Any]:
    """Colour and line style of the index-th method, the same in every figure."""
    style = _STYLES[index // len(_COLOURS) % len(_STYLES)]
    return {"color": _COLOURS[index % len(_COLOURS)], "linestyle": style}


def _bird_eye(T_world: Poses) -> Float[Tensor, "n 2"]:
    """Positions in the ground plane, seen from the first pose [m]."""
    return (se3.inverse(T_world[:1]) @ T_world)[:, :2, 3].cpu()


def _view(paths: list[Float[Tensor, "_ 2"]], truth: Float[Tensor, "n 2"] | None) -> Float[Tensor, "2 2"]:
    """Lower and upper corner of the shown area [m]: the truth, and all paths except where they stray far from it."""
    points = torch.cat(paths if truth is None else [*paths, truth])
    corners = torch.stack([points.amin(0), points.amax(0)])
    if truth is not None:
        lower, upper = truth.amin(0), truth.amax(0)
        reach = (upper - lower).max()
        corners = torch.stack([corners[0].maximum(lower - reach), corners[1].minimum(upper + reach)])
    extent = (corners[1] - corners[0]).max().clamp(min=1)
    missing = (0.4 * extent - (corners[1] - corners[0])).clamp(min=0) / 2  # a margin for straight drives
    margin = 0.05 * extent + missing
    return corners + torch.stack([-margin, margin])


def _all_speeds(sequences: Mapping[str, Sequence], poses: Mapping[str, Poses]) -> Float[Tensor, "_"]:
    """Speeds [km/h] on all sequences with poses and timestamps, concatenated."""
    parts = [torch.zeros(0, dtype=torch.float64)]
    for name, sequence in sequences.items():
        timestamps, T_world = sequence.timestamps, poses.get(name)
        if timestamps is not None and T_world is not None:
            parts.append(_KMH * speeds(T_world.cpu(), timestamps))
    return torch.cat(parts)


def _speed_edges(true_kmh: Float[Tensor, "_"], estimated_kmh: Float[Tensor, "_"]) -> list[float]:
    """Edges of about forty bins of round width [km/h], up to about 1.5 times the highest true speed."""
    fastest = float(estimated_kmh.max()) if len(estimated_kmh) else 0.0
    if len(true_kmh):
        fastest = max(float(true_kmh.max()), min(fastest, 1.5 * float(true_kmh.max()) + 5))
    width = next((w for w in (0.1, 0.2, 0.5, 1.0, 2.0, 5.0) if fastest <= 40 * w), 10.0)
    return [width * i for i in range(max(1, math.ceil(fastest / width)) + 1)]


def _histogram(axes: Axes, kmh: Float[Tensor, "n"], edges: list[float], **style: Any) -> None:
    """Draw the share of the scans [%] in each bin; speeds beyond the last edge count in the last bin."""
    shown = kmh.clamp(max=edges[-1]).numpy()
    axes.hist(shown, edges, weights=np.full(len(shown), 100 / max(1, len(shown))), **style)
