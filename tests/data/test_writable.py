"""Where nothing can be written, one error that names the setting."""

from pathlib import Path

import pytest

from lidarlearn.commands.data import compose_data_set, main
from lidarlearn.data.cache import cached_vertex_maps
from lidarlearn.data.writable import writable
from lidarlearn.errors import UserError
from tests.box_world import SMALL, BoxSequence
from tests.data.writers import random_points, write_float32


@pytest.fixture
def blocked(tmp_path):
    """A folder that cannot be made, whoever tries: a file stands in its way."""
    (tmp_path / "file").write_text("")
    return tmp_path / "file" / "folder"


def test_a_writable_folder_is_made_and_left_empty(tmp_path):
    folder = writable(tmp_path / "a" / "b", "x=y")
    assert folder.is_dir() and not list(folder.iterdir())


def test_a_folder_in_which_nothing_can_be_made():
    with pytest.raises(UserError, match=r"/proc cannot be written to(.|\n)*change: x=y"):
        writable(Path("/proc"), "x=y")


def test_simulated_drives(blocked):
    with pytest.raises(UserError, match=r"data\.root=(.|\n)*LIDARLEARN_DATA"):
        compose_data_set(["data=simulated_urban", f"data.root={blocked}"]).prepare(["urban_07"])


def test_vertex_maps(blocked):
    with pytest.raises(UserError, match=r"datamodule\.cache_root=(.|\n)*LIDARLEARN_CACHE"):
        cached_vertex_maps(BoxSequence("1", frames=2), SMALL, blocked)


def test_exports(blocked, tmp_path, capsys):
    write_float32(tmp_path / "scans" / "0.bin", random_points(0))
    with pytest.raises(SystemExit) as exited:
        main(["export", "data=folder", f"data.root={tmp_path}/scans", "to=kitti_00-08", f"to.root={blocked}"])
    assert exited.value.code == 1 and "to.root=" in capsys.readouterr().err
