import pytest
import torch

from lidarlearn.evaluation import figure as figure_module
from lidarlearn.evaluation.plots import (
    drift_figure,
    figures,
    frame_error_figure,
    speed_figure,
    trajectory_figure,
)
from lidarlearn.evaluation.score import score
from lidarlearn.geometry import se3
from lidarlearn.metrics.kitti import SegmentAverage


def legend(figure):
    return [text.get_text() for text in figure.legends[0].get_texts()]


def test_trajectory_figure_aligns_starts_and_scales_equally(make_drive, longer):
    truth = make_drive(80)
    elsewhere = se3.exp(torch.tensor([50.0, 7, 1, 0.1, 0.2, 2.0], dtype=torch.float64)) @ truth
    figure = trajectory_figure("a", truth, {"same": elsewhere, "longer": longer(truth, 0.1)})
    (axes,) = figure.axes
    assert axes.get_aspect() == 1
    assert legend(figure) == ["ground truth", "same", "longer", "start"]
    assert "[m]" in axes.get_xlabel()
    assert "[m]" in axes.get_ylabel()
    true, same, far, _ = (torch.tensor(line.get_xydata()) for line in axes.lines)
    assert torch.allclose(true, truth[:, :2, 3])
    assert torch.allclose(same, true, atol=1e-9)
    assert far[-1, 0] > true[-1, 0]


def test_trajectory_figure_clips_diverged_trajectory(make_drive, longer):
    truth = make_drive(60)
    (axes,) = trajectory_figure("a", truth, {"runaway": longer(truth, 1000.0)}).axes
    assert axes.get_xlim()[1] < 3 * float(truth[:, 0, 3].max())


@pytest.mark.parametrize("scale", [(1.0, 0.02), (1.0, 1.0), (0.02, 1.0)], ids=["along_x", "square", "along_y"])
def test_trajectory_figure_contains_labels_and_legend(scale):
    angle = torch.linspace(0, 6.28, 200, dtype=torch.float64)
    T_world = se3.identity(200)
    T_world[:, :2, 3] = 200 * torch.stack([angle.sin(), angle.cos()], dim=1) * torch.tensor(scale)
    figure = trajectory_figure("a", T_world, {"posenet_icp+p_f2m": T_world})
    figure.draw_without_rendering()
    (axes,) = figure.axes
    for label in (axes.xaxis.label, axes.yaxis.label, figure.legends[0]):
        box = label.get_window_extent()
        assert min(box.x0, box.y0) >= 0 and box.x1 <= figure.bbox.width and box.y1 <= figure.bbox.height


def test_trajectory_figure_contains_legend_of_24_methods(make_drive):
    T = make_drive(50)
    figure = trajectory_figure("a", T, {f"posenet+method_{i}": T for i in range(24)})
    box = figure.legends[0].get_window_extent()
    assert box.y0 >= 0 and box.y1 <= figure.bbox.height and len(figure.legends[0].texts) == 26


@pytest.mark.parametrize("frames", [1, 2])
def test_trajectory_figure_of_one_or_two_poses(make_drive, frames):
    T = make_drive(frames)
    figure = trajectory_figure("a", None, {"m": T})
    (axes,) = figure.axes
    assert legend(figure) == ["m", "start"]
    assert axes.get_xlim()[0] < axes.get_xlim()[1]


def test_drift_figure_plots_errors_over_length():
    averages = {"m": {100: SegmentAverage(3, 1.5, 0.4), 200: SegmentAverage(1, 1.0, 0.3)}}
    left, right = drift_figure("a", averages).axes
    assert left.lines[0].get_xydata().tolist() == [[100, 1.5], [200, 1.0]]
    assert right.lines[0].get_ydata().tolist() == [0.4, 0.3]
    assert (left.get_ylabel(), right.get_ylabel()) == ("translation error [%]", "rotation error [deg/100 m]")


def test_speed_figure_sums_to_100_percent_with_outlier():
    true = torch.linspace(0, 50, 200, dtype=torch.float64)
    outlier = torch.cat([true, torch.tensor([900.0], dtype=torch.float64)])
    (axes,) = speed_figure("a", true, {"m": outlier}).axes
    assert sum(bar.get_height() for bar in axes.patches if hasattr(bar, "get_height")) == pytest.approx(100)
    assert axes.get_xlim()[1] < 100  # in spite of the outlier
    assert "the last bin holds all beyond" in axes.get_xlabel()
    assert "km/h" in axes.get_ylabel()


def test_frame_error_figure_marks_failure_limits(make_drive, longer):
    truth = make_drive(40)
    upper, lower = frame_error_figure("a", truth, {"m": longer(truth, 0.1)}).axes
    assert upper.get_yscale() == lower.get_yscale() == "log"
    assert [axes.lines[-1].get_ydata()[0] for axes in (upper, lower)] == [1.0, 3.0]
    assert upper.lines[0].get_ydata().tolist() == pytest.approx([0.1] * 39, rel=1e-3)
    assert lower.get_xlabel() == "scan"


def test_frame_error_figure_clamps_tiny_errors(make_drive):
    truth = make_drive(40)
    turned = se3.exp(torch.tensor([0, 0, 0, 0.1, 0.2, 0.3], dtype=torch.float64)) @ truth
    for axes in frame_error_figure("a", truth, {"same": truth, "turned": turned}).axes:
        assert all(line.get_ydata().tolist() == [1e-6] * 39 for line in axes.lines[:2])


def test_methods_have_distinct_styles_in_all_figures(make_drive):
    T = make_drive(20)
    methods = {f"m{i}": T for i in range(12)}
    (axes,) = trajectory_figure("a", None, methods).axes
    looks = [(line.get_color(), line.get_linestyle()) for line in axes.lines[:12]]
    assert len(set(looks)) == 12
    errors = frame_error_figure("a", T, methods).axes[0]
    assert [(line.get_color(), line.get_linestyle()) for line in errors.lines[:12]] == looks


def test_figures_of_evaluation_are_written_as_png(tmp_path, make_sequence, longer, unknown_drive):
    sequences = {"a": make_sequence("a", 150), "unknown": unknown_drive}
    estimates = {"m": {"a": longer(sequences["a"].T_world_lidar, 0.02), "unknown": se3.identity(5)}}
    scores = [score("m", T, sequences[name]) for name, T in estimates["m"].items()]
    drawn = dict(figures(sequences, estimates, scores))
    assert sorted(drawn) == [
        "error_over_distance",
        "frame_errors_a",
        "speed_distribution",
        "trajectories_a",
        "trajectories_unknown",
    ]
    for name, figure in drawn.items():
        figure.savefig(tmp_path / f"{name}.png", dpi=40)
        assert (tmp_path / f"{name}.png").read_bytes().startswith(b"\x89PNG")


def test_figures_accept_any_name(make_sequence):
    """Letters without a font do not warn, and formulas are not parsed."""
    name = "测试 a$b_{c$d"
    sequence = make_sequence(name, 150)
    estimates = {name: {name: sequence.T_world_lidar}}
    scores = [score(name, sequence.T_world_lidar, sequence)]
    drawn = dict(figures({name: sequence}, estimates, scores))
    assert len(drawn) == 4
    for figure in drawn.values():
        figure.draw_without_rendering()
        assert name in figure.axes[0].get_title(loc="left") and name in legend(figure)
    errors = drawn[f"frame_errors_{name}"].axes[0].yaxis.get_ticklabels()
    assert all(label.get_parse_math() for label in errors)  # powers of ten


def test_figures_add_installed_east_asian_fonts(monkeypatch, make_drive):
    monkeypatch.setattr(figure_module, "_EAST_ASIAN", ("of another system", "DejaVu Serif"))
    figure = trajectory_figure("a", None, {"m": make_drive(5)})
    assert figure.axes[0].title.get_fontfamily() == ["sans-serif", "DejaVu Serif"]


def test_figures_without_ground_truth_show_trajectories_alone(unknown_drive):
    drawn = dict(figures({"unknown": unknown_drive}, {"m": {"unknown": se3.identity(5)}}, []))
    assert list(drawn) == ["trajectories_unknown"]


def test_figures_skip_sequences_without_estimates(unknown_drive):
    drawn = dict(figures({"first": unknown_drive, "second": unknown_drive}, {"m": {"first": se3.identity(5)}}, []))
    assert list(drawn) == ["trajectories_first"]


def test_figures_have_speed_distribution_per_group(make_sequence, longer):
    sequences = {"slow": make_sequence("slow", 50), "fast": make_sequence("fast", 50)}
    sequences["fast"].T_world_lidar = longer(sequences["fast"].T_world_lidar, 2.0)
    estimates = {"m": {name: s.T_world_lidar for name, s in sequences.items()}}
    drawn = dict(figures(sequences, estimates, [], {"town, 30": ["slow"], "motorway": ["fast"]}))
    edges = {name: figure.axes[0].get_xlim()[1] for name, figure in drawn.items() if name.startswith("speed")}
    assert list(edges) == ["speed_distribution", "speed_distribution_town_30", "speed_distribution_motorway"]
    assert edges["speed_distribution_town_30"] < 60 < edges["speed_distribution_motorway"]
    assert drawn["speed_distribution_motorway"].axes[0].get_title(loc="left") == "motorway"
