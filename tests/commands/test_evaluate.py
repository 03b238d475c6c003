"""`python evaluate.py` as users call it, on a folder of scans."""

import json
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from lidarlearn.commands import evaluate, evaluation
from lidarlearn.commands.train import train
from lidarlearn.data.cloud_files import read_cloud
from lidarlearn.source_digest import source_digest
from tests.commands.scans import SENSOR
from tests.training.runs import configured

pytestmark = pytest.mark.filterwarnings("ignore::DeprecationWarning:tensorboard")


@pytest.fixture(scope="module")
def checkpoint(tmp_path_factory):
    folder = tmp_path_factory.mktemp("network") / "run"
    return train(configured(folder, "trainer.max_epochs=1", frames=9, train_sequences=["0"]), "boxes")


def results(folder):
    return json.loads((folder / "results.json").read_text())


def rows(folder):
    return {(row["method"], row["sequence"]): row for row in results(folder)["results"]}


def test_a_run_is_taken_up_where_it_was_left(call, no_plots, tmp_path):
    run = f"hydra.run.dir={tmp_path}"
    call(run, "methods=[cv+p_f2m]", "data.test_sequences=['0']")
    before = (tmp_path / "trajectories/cv+p_f2m/0.txt").stat().st_mtime_ns
    printed = call(run, "methods=[cv+p_f2m,ni]", "data.test_sequences=['0','1']")
    assert (tmp_path / "trajectories/cv+p_f2m/0.txt").stat().st_mtime_ns == before
    assert printed.count("found in the run folder") == 1
    assert "ni on 1: 6 scans\n" in printed and "cv+p_f2m on 0: 6 scans\n" not in printed  # what a log says at once
    assert set(rows(tmp_path)) == {(m, s) for m in ("cv+p_f2m", "ni") for s in ("0", "1")}


@pytest.mark.slow
def test_a_run_with_other_settings_is_not_taken_for_this_one(call, no_plots, tmp_path):
    run = f"hydra.run.dir={tmp_path}"
    call(run, "methods=[cv+p_f2m]", "data.test_sequences=['0']")
    printed = call(run, "methods=[cv+p_f2m]", "data.test_sequences=['0']", "odometry.p_f2m.local_map.size=2")
    assert "cv+p_f2m on 0: run again, the run folder has it with other settings (odometry)" in printed
    settings = json.loads((tmp_path / "trajectories/cv+p_f2m/0.json").read_text())["settings"]
    assert settings["odometry"]["local_map"]["size"] == 2


def test_a_run_of_the_user_s_own_class_is_taken_up_until_its_file_is_edited(call, no_plots, tmp_path, monkeypatch):
    monkeypatch.syspath_prepend(tmp_path)
    own = ["methods=[mine]", "+initialization.mine={_target_:my_initialization.Own}", "data.test_sequences=['0']"]
    printed = []
    for base in ("NoInitialization", "NoInitialization", "ConstantVelocity"):
        (tmp_path / "my_initialization.py").write_text(
            f"from lidarlearn.odometry.initialization import {base}\nclass Own({base}): ...\n"
        )
        monkeypatch.delitem(sys.modules, "my_initialization", raising=False)  # as another process begins
        source_digest.cache_clear()
        printed.append(call(f"hydra.run.dir={tmp_path}", *own))
    assert ["found in the run folder" in text for text in printed] == [False, True, False]
    assert "mine on 0: run again, the run folder has it with other settings (code)" in printed[2]


@pytest.mark.slow
def test_an_export_that_was_cut_short_is_run_again(call, no_plots, tmp_path):
    run = f"hydra.run.dir={tmp_path}"
    call(run, "methods=[ni]", "data.test_sequences=['0']")
    (tmp_path / "trajectories/ni/0.json").unlink()
    assert "found" not in call(run, "methods=[ni]", "data.test_sequences=['0']")


def test_networks_have_names_of_their_own(call, checkpoint, tmp_path):
    call(
        f"hydra.run.dir={tmp_path}", "methods=[other,other+p_f2f]", f"+networks.other='{checkpoint}'",
        "data.test_sequences=['0']",
    )  # fmt: skip
    assert set(rows(tmp_path)) == {("other", "0"), ("other+p_f2f", "0")}
    protocol = results(tmp_path)["protocol"]
    assert protocol["checkpoint"] is None and protocol["networks"]["other"]["path"] == str(checkpoint)
    # the network was trained on sequence 0 of the same name
    assert "*" in (tmp_path / "results.md").read_text()


def test_a_network_that_is_not_there_is_named(call, tmp_path, capsys):
    with pytest.raises(SystemExit):
        call(f"hydra.run.dir={tmp_path}", "methods=[other+p_f2f]", "+networks.other=null")
    assert "networks.other=RUN/checkpoints/best.ckpt" in capsys.readouterr().err


@pytest.fixture
def no_data(monkeypatch):
    """Where data are asked for, it is too late."""
    monkeypatch.setattr(evaluate, "instantiate", lambda *_, **__: 1 / 0)


def refused(capsys, *arguments):
    with pytest.MonkeyPatch.context() as patch, pytest.raises(SystemExit):
        patch.setattr(sys, "argv", ["evaluate.py", *arguments])
        evaluate.main()
    return capsys.readouterr().err


def test_all_networks_that_are_not_there_are_named_before_data_are_made(no_data, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    error = refused(capsys, "experiment=paper/generalization_sim", "device=cpu")
    for name in ("campus", "urban"):
        assert f"networks.posenet_{name}: no file outputs/network/simulated_{name}/checkpoints/best.ckpt" in error
        assert f"python train.py experiment=network/simulated_{name}" in error


def test_a_checkpoint_that_nothing_uses_is_refused(no_data, checkpoint, tmp_path, capsys):
    chosen = ("data=kitti_00-08", "experiment=paper/kitti")
    error = refused(capsys, f"ckpt='{checkpoint}'", *chosen, f"hydra.run.dir={tmp_path}")
    assert f"change: networks.posenet={checkpoint}" in error
    error = refused(capsys, f"ckpt='{checkpoint}'", "data=folder", "methods=[cv+p_f2m]", f"hydra.run.dir={tmp_path}")
    assert "no method uses this network" in error


TABLE = (
    "table={_target_:lidarlearn.evaluation.table_layout.TableLayout,title:both,"
    "figure:relative_translation_error_percent,columns:{first:['0'],second:['1']}}"
)


def test_the_jobs_of_a_multirun_end_in_one_table(call, no_plots, tmp_path):
    printed = call(
        "-m", f"hydra.sweep.dir={tmp_path}", "data.test_sequences=['0'],['1']", "methods=[ni],[cv+p_f2m]", TABLE
    )
    (group,) = results(tmp_path)["compared"]
    assert [(row["method"], row["sequence"]) for row in group["results"]] == [
        ("ni", "0"), ("ni", "1"), ("cv+p_f2m", "0"), ("cv+p_f2m", "1"),
    ]  # fmt: skip
    assert group["averages"][0]["mean_over_sequences"]["relative_translation_error_percent"] > 99  # it stands still
    text = (tmp_path / "results.md").read_text()
    assert text.startswith("# Results\n\n### both") and "first" in printed


def test_a_job_that_fails_leaves_the_others_their_table(call, no_plots, tmp_path, capsys):
    with pytest.raises(SystemExit) as exit_:
        call("-m", f"hydra.sweep.dir={tmp_path}", "data.test_sequences=['0'],['7'],['1']", "methods=[ni]")
    assert exit_.value.code == 1
    assert "error: job 1: " in capsys.readouterr().err
    (group,) = results(tmp_path)["compared"]
    assert [row["sequence"] for row in group["results"]] == ["0", "1"]


def test_where_every_job_fails_each_says_why_and_no_table_is_missed(call, no_plots, tmp_path, capsys):
    with pytest.raises(SystemExit) as exit_:
        call("-m", f"hydra.sweep.dir={tmp_path}", "data.test_sequences=['7'],['8']", "methods=[ni]")
    printed = capsys.readouterr()
    assert exit_.value.code == 1 and "error: job 0: " in printed.err
    assert "IndexError" not in printed.out + printed.err and not (tmp_path / "results.md").exists()


@pytest.mark.slow
def test_jobs_run_in_parallel_processes(scans, tmp_path):
    program = Path(__file__).parents[2] / "evaluate.py"
    parallel = ["-m", "hydra/launcher=joblib", "hydra.launcher.n_jobs=2", f"hydra.sweep.dir={tmp_path}"]
    own = ["device=cpu", "data=folder", f"data.root={scans}", *SENSOR, "methods=[ni]"]
    command = [sys.executable, str(program), *parallel, *own, "data.test_sequences=['0'],['7'],['1']"]
    done = subprocess.run(command, capture_output=True, text=True)
    assert done.returncode == 1 and "error: job 1: " in done.stderr
    (group,) = results(tmp_path)["compared"]
    assert [row["sequence"] for row in group["results"]] == ["0", "1"]


@pytest.mark.slow
def test_compare_prints_and_writes(call, no_plots, tmp_path, monkeypatch, capsys):
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


@pytest.mark.parametrize(("override", "remedy"), [("probe.every=100", "probe.every"), ("backends=[]", "p_f2m")])
def test_a_basin_that_cannot_be_measured_is_refused(scans, tmp_path, monkeypatch, capsys, override, remedy):
    own = ["data=folder", f"data.root={scans}", *SENSOR, "data.test_sequences=['0']", f"hydra.run.dir={tmp_path}"]
    monkeypatch.setattr(sys, "argv", ["x", "convergence", *own, override])
    with pytest.raises(SystemExit) as exit_:
        evaluation.main()
    error = capsys.readouterr().err
    assert exit_.value.code == 1 and error.startswith("error: ") and remedy in error


def test_basins_of_convergence_are_measured_and_drawn(scans, tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(
        sys, "argv",
        ["x", "convergence", "data=folder", f"data.root={scans}", *SENSOR, "data.test_sequences=['0']",
         "backends=[p_f2m,kd_f2m]", "probe.every=3", "probe.offsets_m=[0.1,20.0]", "probe.angles_deg=[1.0,170.0]",
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
    """Runs the command map; what it prints, and the error with which it gives up."""

    def run(*arguments):
        monkeypatch.setattr(sys, "argv", ["x", "map", *map(str, arguments)])
        try:
            evaluation.main()
        except SystemExit as exit_:
            assert exit_.code == 1
        printed = capsys.readouterr()
        return printed.out, printed.err

    return run


def test_maps_are_made_of_what_a_run_has_left(call, no_plots, maps_of, scans, tmp_path):
    run, copy = tmp_path / "run", tmp_path / "copy"
    call(f"hydra.run.dir={run}", "methods=[cv+kd_f2m,ni]", "data.test_sequences=['0','1']")
    printed, error = maps_of(run, "--voxel", "0.5", "--sequence", "1", "--min-range=1")
    assert not error and "cv+kd_f2m" in printed and "MPV" in printed
    rows = {row["method"]: row for row in json.loads((run / "maps/maps.json").read_text())["maps"]}
    assert rows["ni"]["mean_plane_variance_m2"] > rows["cv+kd_f2m"]["mean_plane_variance_m2"] > 0
    assert rows["cv+kd_f2m"]["extent_m"] == pytest.approx([60, 24, 7.7], abs=1)  # the hall
    cloud, picture = (run / "maps/cv+kd_f2m" / name for name in ("1.ply", "1.png"))
    assert cloud.stat().st_size == rows["cv+kd_f2m"]["file_bytes"] and picture.is_file()
    assert len(read_cloud(cloud).points) == rows["cv+kd_f2m"]["points"]

    shutil.copytree(scans, copy)  # another machine
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


def test_an_interrupted_drive_gets_no_map(call, no_plots, maps_of, tmp_path):
    call(f"hydra.run.dir={tmp_path}", "methods=[ni]", "data.test_sequences=['0']")
    for path in sorted((tmp_path / "trajectories/ni").iterdir()):
        path.rename(path.with_name(path.name.replace("0.", "0.partial.")))
    error = maps_of(tmp_path)[1]
    assert "trajectories/ni/0.partial.txt" in error and f"hydra.run.dir={tmp_path}" in error


def test_maps_are_made_of_runs_only_and_their_configuration_runs_no_code(maps_of, tmp_path):
    assert "run folder of evaluate.py" in maps_of(tmp_path)[1]
    (tmp_path / "trajectories").mkdir()
    (tmp_path / "config.yaml").write_text("data:\n  _target_: os.system\n  command: 'false'\n")
    assert "os.system" in maps_of(tmp_path)[1]


def test_other_commands_say_what_there_is(monkeypatch, capsys):
    monkeypatch.setattr(sys, "argv", ["x", "comapre"])
    with pytest.raises(SystemExit) as exit_:
        evaluation.main()
    assert exit_.value.code == 2 and "convergence" in capsys.readouterr().out
