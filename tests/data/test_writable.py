"""Errors for folders that cannot be written to name the setting."""

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
    """A folder that not even a superuser can make: its parent is a file."""
    (tmp_path / "file").write_text("")
    return tmp_path / "file" / "folder"


def test_writable_makes_empty_folder(tmp_path):
    folder = writable(tmp_path / "a" / "b", "x=y")
    assert folder.is_dir() and not list(folder.iterdir())


def test_read_only_folder_error_names_setting():
    with pytest.raises(UserError, match=r"/proc cannot be written to(.|\n)*change: x=y"):
        writable(Path("/proc"), "x=y")


def test_simulation_error_names_data_root(blocked):
    with pytest.raises(UserError, match=r"data\.root=(.|\n)*LIDARLEARN_DATA"):
        compose_data_set(["data=simulated_urban", f"data.root={blocked}"]).prepare(["urban_07"])


def test_cache_error_names_cache_root(blocked):
    with pytest.raises(UserError, match=r"datamodule\.cache_root=(.|\n)*LIDARLEARN_CACHE"):
        cached_vertex_maps(BoxSequence("1", frames=2), SMALL, blocked)


def test_export_error_names_target_root(blocked, tmp_path, capsys):
    write_float32(tmp_path / "scans" / "0.bin", random_points(0))
    with pytest.raises(SystemExit) as exited:
        main(["export", "data=folder", f"data.root={tmp_path}/scans", "to=kitti_00-08", f"to.root={blocked}"])
    assert exited.value.code == 1 and "to.root=" in capsys.readouterr().err
