"""Results of several runs side by side."""

import json

import pytest

from lidarlearn.data.pose_files import write_kitti_poses
from lidarlearn.errors import UserError
from lidarlearn.evaluation.compare import comparable_groups, comparison, read_run
from lidarlearn.evaluation.report import write_report, write_results
from lidarlearn.evaluation.run import Export
from lidarlearn.evaluation.score import score
from lidarlearn.evaluation.table_layout import TableLayout

PROTOCOL = {"data": "towns", "beam_correction_deg": 0.0, "deskew": False, "max_frames": None}


@pytest.fixture
def make_run(tmp_path, make_sequence, longer):
    """Writes the folder of a run that was off by a share of the motion, with the given settings."""

    def make(name, method, sequence, share=0.01, settings=None, layout=None, **protocol):
        folder, drive = tmp_path / name, make_sequence(sequence, 300)
        T_world = longer(drive.T_world_lidar, share)
        stamp = PROTOCOL | {"scans": {sequence: "f00d"}, "ground_truth": {sequence: "7007"}} | protocol
        write_report(folder, stamp, [score(method, T_world, drive, 10.0)], layout=layout)
        if settings is not None:
            export = Export(folder / "trajectories" / method, sequence)
            write_kitti_poses(export.kitti, T_world)
            export.summary.write_text(json.dumps({"settings": {"scans": "f00d"} | settings}))
        return folder

    return make


def groups(*folders):
    return comparable_groups([read_run(folder) for folder in folders])


def methods(group):
    return [(row.method, row.sequence) for row in group.scores]


def test_read_run_restores_scores_exactly(make_run, make_sequence, longer):
    drive = make_sequence("a", 300)
    expected = score("m", longer(drive.T_world_lidar, 0.01), drive, 10.0)
    assert read_run(make_run("r", "m", "a")).scores == [expected]


def test_runs_on_different_sequences_share_a_row(make_run):
    (group,) = groups(make_run("1", "m", "a", settings={"k": 1}), make_run("2", "m", "b", settings={"k": 1}))
    assert methods(group) == [("m", "a"), ("m", "b")]
    _, (drift, _), _ = comparison([group])
    assert [row[0] for row in drift.rows] == ["m"]
    assert drift.columns[1:3] == ("a", "b")


def test_rows_name_differing_setting(make_run):
    first = make_run("1", "m", "a", settings={"odometry": {"local_map": {"size": 30}, "same": 1}})
    second = make_run("2", "m", "a", settings={"odometry": {"local_map": {"size": 20}, "same": 1}})
    (group,) = groups(first, second)
    assert [row.method for row in group.scores] == ["m [size=30]", "m [size=20]"]


def test_ambiguous_setting_names_are_written_in_full(make_run):
    first = make_run("1", "m", "a", settings={"a": {"size": 1}, "b": {"size": 5}})
    second = make_run("2", "m", "a", settings={"a": {"size": 2}, "b": {"size": 6}})
    (group,) = groups(first, second)
    assert [row.method for row in group.scores] == ["m [a.size=1, b.size=5]", "m [a.size=2, b.size=6]"]


def test_differing_part_is_named_by_class_and_its_settings(make_run):
    huber = {"weight": {"_target_": "lidarlearn.registration.weights.Huber", "delta_m": 0.2}}
    cauchy = {"weight": {"_target_": "lidarlearn.registration.weights.Cauchy", "sigma_m": 0.1}}
    (group,) = groups(make_run("1", "m", "a", settings=huber), make_run("2", "m", "a", settings=cauchy))
    assert [row.method for row in group.scores] == ["m [weight=Huber, delta_m=0.2]", "m [weight=Cauchy, sigma_m=0.1]"]


def test_projection_of_data_is_no_setting_of_the_method(make_run):
    runs = [
        make_run(s, "m", s, settings={"sampling": {"projection": {"height": h}}}) for s, h in (("a", 64), ("b", 32))
    ]
    (group,) = groups(*runs)
    assert methods(group) == [("m", "a"), ("m", "b")]


def test_repeated_run_keeps_both_rows(make_run):
    (group,) = groups(make_run("1", "m", "a", settings={"k": 1}), make_run("2", "m", "a", settings={"k": 1}))
    assert methods(group) == [("m", "a"), ("m (2)", "a")]


def test_repeated_runs_are_labelled_by_distinct_part_of_path(make_run):
    runs = [make_run(f"{sweep}/0", "m", "a", settings={"k": 1}) for sweep in ("A", "B", "C")]
    (group,) = groups(*runs)
    assert methods(group) == [("m", "a"), ("m (B/0)", "a"), ("m (C/0)", "a")]
    (group,) = groups(*runs, make_run("other", "m", "b", settings={"k": 1}))
    assert methods(group) == [("m", "a"), ("m", "b"), ("m (B/0)", "a"), ("m (C/0)", "a")]


def test_run_without_settings_is_not_labelled_by_settings(make_run):
    own = [make_run(f"own_{k}", "m", "a", settings={"k": k, "same": 1}) for k in (1, 2)]
    (group,) = groups(*own, make_run("scored_again", "m", "a"))
    assert methods(group) == [("m [k=1]", "a"), ("m [k=2]", "a"), ("m", "a")]
    (group,) = groups(own[0], make_run("scored_again", "m", "a"))
    assert methods(group) == [("m", "a"), ("m (scored_again)", "a")]


def test_networks_are_marked_on_their_own_training_sequences(make_run):
    def run(digest, seen, evaluated):
        network = {"path": "best.ckpt", "sha256": digest, "trained_on": {"train_sequences": seen}}
        return make_run(
            f"{digest[0]}_{evaluated}", "posenet", evaluated, settings={"network": digest}, checkpoint=network
        )

    parts = groups(run("a" * 64, ["x"], "x"), run("a" * 64, ["x"], "y"), run("b" * 64, ["y"], "x"))
    (drift, _) = comparison(parts)[1]
    marked = {row[0]: ["*" in cell for cell in row[1:3]] for row in drift.rows}
    assert marked == {"posenet [network=aaaaaaaa]": [True, False], "posenet [network=bbbbbbbb]": [False, False]}


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"beam_correction_deg": 0.205}, "beam_correction_deg: 0.0 against 0.205"),
        ({"deskew": True}, "deskew: false against true"),
        ({"max_frames": 50}, "max_frames: null against 50"),
        ({"scans": {"a": "beef"}}, "not the same scans of sequence a"),
        ({"ground_truth": {"a": "beef"}}, "not the same ground truth of sequence a"),
    ],
)
def test_incomparable_runs_are_separated_with_reason(make_run, change, words):
    apart = groups(make_run("1", "m", "a"), make_run("2", "n", "a", **change), make_run("3", "o", "a"))
    assert [methods(group) for group in apart] == [[("m", "a"), ("o", "a")], [("n", "a")]]
    _, tables, closing = comparison(apart)
    assert len(tables) == 4 and "(2 of 2: towns" in tables[2].title
    assert "Not comparable: 1 and 2" in closing and words in closing


def test_results_without_ground_truth_digest_stay_comparable(make_run):
    (group,) = groups(make_run("1", "m", "a"), make_run("2", "n", "a", ground_truth={}))
    assert methods(group) == [("m", "a"), ("n", "a")]


def test_table_of_experiment_spans_data_sets(make_run, tmp_path):
    layout = TableLayout("both", {"towns": ["a"], "campus": ["b"]}, published={"m": [1.0, 2.0]})
    parts = groups(make_run("1", "m", "a", layout=layout), make_run("2", "m", "b", layout=layout, deskew=True))
    content, tables, closing = comparison(parts)
    assert tables[0].title == "both"
    ((name, towns, campus),) = tables[0].rows
    assert name == "m" and float(towns) > 0 and float(campus) > 0
    write_results(tmp_path / "joint", content, tables, closing)
    written = json.loads((tmp_path / "joint" / "results.json").read_text())
    assert [len(group["results"]) for group in written["compared"]] == [1, 1]
    assert "both" in (tmp_path / "joint" / "results.md").read_text()


def test_table_of_experiment_does_not_average_repeated_results(make_run):
    layout = TableLayout("both", {"towns": ["a", "b"]})
    runs = [make_run(str(share), "m", "a", share, layout=layout, max_frames=int(1e4 * share)) for share in (0.01, 0.02)]
    _, tables, _ = comparison(groups(*runs))
    cells = {table.title: table.rows for table in tables if table.title.startswith("both")}
    (first, one), (second, two) = cells.items()
    assert "(1 of 2: towns" in first and "max_frames 200" in second
    errors = [read_run(run).scores[0].avg_translation_error_percent for run in runs]
    assert [one, two] == [(("m", f"{error:.3f} (1 of 2)"),) for error in errors]


def test_read_run_names_folder_without_results(tmp_path):
    with pytest.raises(UserError, match=r"results\.json: no such file"):
        read_run(tmp_path)
    (tmp_path / "results.json").write_text("{}")
    with pytest.raises(UserError, match=r"results\.json: not the result of an evaluation"):
        read_run(tmp_path)
