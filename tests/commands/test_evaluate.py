"""`python evaluate.py` and `python -m lidarlearn.evaluation`, as users call them on a folder of scans."""

import json
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from lidarlearn.commands import evaluate, evaluation
from lidarlearn.data.cloud_files import read_cloud
from lidarlearn.errors import UserError
from lidarlearn.source_digest import source_digest
from tests.commands.configs import composed
from tests.commands.scans import configured, evaluate_scans, on_scans

pytestmark = pytest.mark.filterwarnings("ignore::DeprecationWarning:tensorboard")


def results(folder):
    return json.loads((folder / "results.json").read_text())


def rows(folder):
    return {(row["method"], row["sequence"]): row for row in results(folder)["results"]}


def test_evaluation_resumes_with_missing_and_interrupted_trajectories(scans, run_copy, capsys):
    """Settings are written last: without them, an export was interrupted."""
    trajectories = run_copy / "trajectories"
    (trajectories / "ni" / "1.json").unlink()
    for path in (trajectories / "cv+kd_f2m").glob("0.*"):
        path.unlink()
    finished = trajectories / "cv+kd_f2m" / "1.txt"
    before = finished.stat().st_mtime_ns
    evaluate_scans(scans, run_copy, "methods=[cv+kd_f2m,ni]")
    printed = capsys.readouterr().out
    assert finished.stat().st_mtime_ns == before and printed.count("found in the run folder") == 2
    assert "ni on 1: 6 scans\n" in printed and "cv+kd_f2m on 0: 6 scans\n" in printed  # each line appears at once
    assert "cv+kd_f2m on 1: 6 scans\n" not in printed
    assert set(rows(run_copy)) == {(m, s) for m in ("cv+kd_f2m", "ni") for s in ("0", "1")}


def test_evaluation_runs_again_with_other_settings(scans, run_copy, capsys):
    changed = ["methods=[cv+kd_f2m]", "data.test_sequences=['0']", "odometry.kd_f2m.local_map.size=2"]
    evaluate_scans(scans, run_copy, *changed)
    printed = capsys.readouterr().out
    assert "cv+kd_f2m on 0: run again, the run folder has it with other settings (odometry)" in printed
    settings = json.loads((run_copy / "trajectories/cv+kd_f2m/0.json").read_text())["settings"]
    assert settings["odometry"]["local_map"]["size"] == 2


def test_trajectory_of_user_class_is_reused_until_its_file_changes(scans, tmp_path, monkeypatch, capsys):
    monkeypatch.syspath_prepend(tmp_path)
    own = ["methods=[mine]", "initialization.mine={_target_: my_initialization.Own}", "data.test_sequences=['0']"]
    printed = []
    for base in ("NoInitialization", "NoInitialization", "ConstantVelocity"):
        (tmp_path / "my_initialization.py").write_text(
            f"from lidarlearn.odometry.initialization import {base}\nclass Own({base}): ...\n"
        )
        monkeypatch.delitem(sys.modules, "my_initialization", raising=False)  # like a new process
        source_digest.cache_clear()
        evaluate_scans(scans, tmp_path, *own)
        printed.append(capsys.readouterr().out)
    assert ["found in the run folder" in text for text in printed] == [False, True, False]
    assert "mine on 0: run again, the run folder has it with other settings (code)" in printed[2]


def test_further_network_is_a_method_of_its_name(scans, network, tmp_path):
    evaluate_scans(
        scans, tmp_path, "methods=[other,other+p_f2f]", f"networks.other={network}", "data.test_sequences=['0']"
    )
    assert set(rows(tmp_path)) == {("other", "0"), ("other+p_f2f", "0")}
    protocol = results(tmp_path)["protocol"]
    assert protocol["checkpoint"] is None and protocol["networks"]["other"]["path"] == str(network)
    assert "*" in (tmp_path / "results.md").read_text()  # trained on sequence 0


def test_network_without_path_is_named(scans, tmp_path):
    with pytest.raises(UserError, match=r"networks\.other=RUN/checkpoints/best\.ckpt"):
        evaluate_scans(scans, tmp_path, "methods=[other+p_f2f]", "networks.other=null")


@pytest.fixture
def no_data(monkeypatch):
    """Fails as soon as the data set is built."""
    monkeypatch.setattr(evaluate, "instantiate", lambda *_, **__: 1 / 0)


def test_all_missing_networks_are_named_before_data_are_built(no_data, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    with pytest.raises(UserError) as error:
        evaluate.evaluate(composed("evaluate", "experiment=paper/generalization_sim"), "simulated_urban")
    for name in ("campus", "urban"):
        missing = f"networks.posenet_{name}: no file outputs/network/simulated_{name}/checkpoints/best.ckpt"
        assert missing in str(error.value)
        assert f"python train.py experiment=network/simulated_{name}" in str(error.value)


@pytest.mark.parametrize("methods", ["experiment=paper/kitti", "methods=[cv+p_f2m]"])
def test_unused_checkpoint_is_refused(no_data, call, network, tmp_path, capsys, methods):
    with pytest.raises(SystemExit):
        call(f"ckpt='{network}'", methods, f"hydra.run.dir={tmp_path}")
    error = capsys.readouterr().err
    assert "no method uses this network" in error and f"change: networks.posenet={network}" in error


TABLE = (
    "table={_target_:lidarlearn.evaluation.table_layout.TableLayout,title:both,"
    "figure:relative_translation_error_percent,columns:{first:['0'],second:['1']}}"
)


def test_multirun_tabulates_all_jobs_but_the_failed(call, tmp_path, capsys):
    with pytest.raises(SystemExit) as exit_:
        call("-m", f"hydra.sweep.dir={tmp_path}", "data.test_sequences=['0'],['7'],['1']", "methods=[ni]", TABLE)
    printed = capsys.readouterr()
    assert exit_.value.code == 1 and "error: job 1: " in printed.err
    (group,) = results(tmp_path)["compared"]
    assert [(row["method"], row["sequence"]) for row in group["results"]] == [("ni", "0"), ("ni", "1")]
    assert group["averages"][0]["mean_over_sequences"]["relative_translation_error_percent"] > 99  # it stands still
    text = (tmp_path / "results.md").read_text()
    assert text.startswith("# Results\n\n### both") and "first" in printed.out


@pytest.mark.slow
def test_multirun_table_groups_rows_by_method(call, tmp_path):
    call("-m", f"hydra.sweep.dir={tmp_path}", "data.test_sequences=['0'],['1']", "methods=[ni],[cv+p_f2m]")
    (group,) = results(tmp_path)["compared"]
    assert [(row["method"], row["sequence"]) for row in group["results"]] == [
        ("ni", "0"), ("ni", "1"), ("cv+p_f2m", "0"), ("cv+p_f2m", "1"),
    ]  # fmt: skip


def test_multirun_without_a_successful_job_has_no_table(call, tmp_path, capsys):
    with pytest.raises(SystemExit) as exit_:
        call("-m", f"hydra.sweep.dir={tmp_path}", "data.test_sequences=['7']", "methods=[ni]")
    printed = capsys.readouterr()
    assert exit_.value.code == 1 and "error: job 0: " in printed.err
    assert "IndexError" not in printed.out + printed.err and not (tmp_path / "results.md").exists()


@pytest.mark.slow
def test_multirun_works_with_joblib(scans, tmp_path):
    program = Path(__file__).parents[2] / "evaluate.py"
    parallel = ["-m", "hydra/launcher=joblib", "hydra.launcher.n_jobs=2", f"hydra.sweep.dir={tmp_path}"]
    own = ["device=cpu", *on_scans(scans), "methods=[ni]"]
    command = [sys.executable, str(program), *parallel, *own, "data.test_sequences=['0'],['7'],['1']"]
    done = subprocess.run(command, capture_output=True, text=True)
    assert done.returncode == 1 and "error: job 1: " in done.stderr
    (group,) = results(tmp_path)["compared"]
    assert [row["sequence"] for row in group["results"]] == ["0", "1"]


@pytest.mark.slow
def test_compare_prints_and_writes_differing_settings(call, tmp_path, monkeypatch, capsys):
    for name, size in (("a", 1), ("b", 2)):
        call(
            f"hydra.run.dir={tmp_path / name}", "methods=[cv+p_f2m]", "data.test_sequences=['0']",
            f"odometry.p_f2m.local_map.size={size}",
        )  # fmt: skip
    folders = [str(tmp_path / name) for name in "ab"]
    monkeypatch.setattr(sys, "argv", ["x", "compare", *folders, "--output", str(tmp_path / "both")])
    evaluation.main()
    printed = capsys.readouterr().out
    assert "[size=1]" in printed and "[size=2]" in printed
    assert (tmp_path / "both" / "results.md").is_file()
    shutil.rmtree(tmp_path / "a")
    with pytest.raises(SystemExit) as exit_:
        evaluation.main()
    assert exit_.value.code == 1 and "results.json: no such file" in capsys.readouterr().err


@pytest.mark.parametrize(("setting", "remedy"), [("probe.every=100", r"probe\.every"), ("backends=[]", "p_f2m")])
def test_convergence_without_probes_or_backends_is_refused(scans, tmp_path, setting, remedy):
    config = configured("convergence", scans, tmp_path, "data.test_sequences=['0']", setting)
    with pytest.raises(UserError, match=remedy):
        evaluation.measure_convergence(config)


def test_convergence_writes_and_draws_basins(scans, tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(
        sys, "argv",
        ["x", "convergence", *on_scans(scans), "data.test_sequences=['0']",
         "backends=[p_f2m,kd_f2m]", "probe.every=5", "probe.directions=4",
         "probe.offsets_m=[0.1,20.0]", "probe.angles_deg=[1.0,170.0]",
         f"hydra.run.dir={tmp_path}"],
    )  # fmt: skip
    evaluation.main()
    basins = json.loads((tmp_path / "convergence.json").read_text())
    assert (tmp_path / "convergence.png").is_file()
    for basin in basins.values():
        assert basin["by_offset_m"]["0.1"] > 0.9 and basin["by_offset_m"]["20.0"] < 0.2
        assert basin["by_angle_deg"]["1.0"] > 0.9 and basin["by_angle_deg"]["170.0"] < 0.6
    printed = capsys.readouterr().out
    assert "kd_f2m on 0: 6 scans\n" in printed and "Registrations that" in printed


@pytest.fixture
def maps_of(monkeypatch, capsys):
    """Runs the command map and returns its output and its error."""

    def run(*arguments):
        monkeypatch.setattr(sys, "argv", ["x", "map", *map(str, arguments)])
        try:
            evaluation.main()
        except SystemExit as exit_:
            assert exit_.code == 1
        printed = capsys.readouterr()
        return printed.out, printed.err

    return run


def test_map_writes_clouds_pictures_and_sharpness(run_copy, maps_of, scans, tmp_path):
    run, copy = run_copy, tmp_path / "copy"
    printed, error = maps_of(run, "--voxel", "0.5", "--sequence", "1", "--min-range=1")
    assert not error and "cv+kd_f2m" in printed and "MPV" in printed
    rows = {row["method"]: row for row in json.loads((run / "maps/maps.json").read_text())["maps"]}
    assert rows["ni"]["mean_plane_variance_m2"] > rows["cv+kd_f2m"]["mean_plane_variance_m2"] > 0
    assert rows["cv+kd_f2m"]["extent_m"] == pytest.approx([60, 24, 7.7], abs=1)  # the hall
    cloud, picture = (run / "maps/cv+kd_f2m" / name for name in ("1.ply", "1.png"))
    assert cloud.stat().st_size == rows["cv+kd_f2m"]["file_bytes"] and picture.is_file()
    assert len(read_cloud(cloud).points) == rows["cv+kd_f2m"]["points"]

    shutil.copytree(scans, copy)  # as on another machine
    maps_of(run, "--method=ni", "--voxel=1", f"data.root={copy}")
    kept, *again = json.loads((run / "maps/maps.json").read_text())["maps"]
    assert kept == rows["cv+kd_f2m"] and [(row["method"], row["sequence"]) for row in again] == [
        ("ni", "0"),
        ("ni", "1"),
    ]
    assert again[1]["settings"]["voxel_size_m"] == 1

    for arguments, parts in (
        (["--method=ei"], ["ei on any sequence", "cv+kd_f2m on 0, cv+kd_f2m on 1, ni on 0, ni on 1"]),
        (["--sequence=7"], ["any method on 7", "--sequence"]),
        (["--voxel=0"], ["--voxel"]),
        (["--voxel=inf"], ["--voxel"]),
        (["data.root"], ["data.KEY=VALUE"]),
        (["data.roott=x"], ["roott"]),
        (["seed=1"], ["data.KEY=VALUE"]),
        ([f"data.root={tmp_path / 'gone'}"], ["gone", "data.root"]),
    ):
        error = maps_of(run, *arguments)[1]
        assert error.startswith("error: ") and all(part in error for part in parts)

    np.save(copy / "1" / "0.npy", np.ones((50, 3), np.float32))
    assert "not the scans of the run" in maps_of(run, "--sequence=1", f"data.root={copy}")[1]
    (run / "maps/maps.json").write_text("{")
    assert "maps.json: damaged" in maps_of(run)[1]


def test_map_refuses_interrupted_drive(run_copy, maps_of):
    for path in sorted((run_copy / "trajectories/ni").glob("0.*")):
        path.rename(path.with_name(path.name.replace("0.", "0.partial.")))
    error = maps_of(run_copy, "--method=ni", "--sequence=0")[1]
    assert "trajectories/ni/0.partial.txt" in error and f"hydra.run.dir={run_copy}" in error


def test_map_refuses_other_folders_and_untrusted_configs(maps_of, tmp_path):
    assert "run folder of evaluate.py" in maps_of(tmp_path)[1]
    (tmp_path / "trajectories").mkdir()
    (tmp_path / "config.yaml").write_text("data:\n  _target_: os.system\n  command: 'false'\n")
    assert "os.system" in maps_of(tmp_path)[1]


def test_unknown_command_lists_the_commands(monkeypatch, capsys):
    monkeypatch.setattr(sys, "argv", ["x", "comapre"])
    with pytest.raises(SystemExit) as exit_:
        evaluation.main()
    assert exit_.value.code == 2 and "convergence" in capsys.readouterr().out
