"""What a result tells about how it came about."""

import json

import pytest

pytestmark = pytest.mark.filterwarnings("ignore::DeprecationWarning:tensorboard")


def protocol(folder):
    return json.loads((folder / "results.json").read_text())["protocol"]


@pytest.fixture
def foreign(scans, tmp_path):
    """Trajectories of another tool."""
    folder = tmp_path / "tool"
    folder.mkdir()
    (folder / "0.txt").write_text((scans / "0" / "poses.txt").read_text())
    return folder


def test_files_that_were_scored_are_told_with_the_frame_they_were_taken_to_be_in(call, no_plots, foreign, tmp_path):
    call(f"hydra.run.dir={tmp_path / 'run'}", f"trajectories={foreign}", "data.test_sequences=['0']")
    assert protocol(tmp_path / "run")["trajectories"] == {"path": str(foreign), "frame": "lidar"}


def test_methods_are_not_left_out_for_files_without_a_word(call, foreign, tmp_path, capsys):
    with pytest.raises(SystemExit):
        call(f"hydra.run.dir={tmp_path / 'run'}", f"trajectories={foreign}", "methods=[ei+kd_f2m]")
    error = capsys.readouterr().err
    assert str(foreign) in error and "ei+kd_f2m" in error and "methods=null" in error
