"""Fixtures of the commands' tests."""

import shutil
import sys

import numpy as np
import pytest
from hydra._internal.hydra import Hydra

from lidarlearn.commands import evaluate
from lidarlearn.data.pose_files import write_kitti_poses
from tests.box_world import BoxSequence
from tests.commands.networks import save_network
from tests.commands.scans import FRAMES, evaluate_scans, on_scans


@pytest.fixture(scope="module", autouse=True)
def use_small_network(small_network):
    """Commands do the same with a network of any size."""


@pytest.fixture(scope="session", autouse=True)
def single_composition():
    """Hydra composes each command line twice, at first only to read `hydra.mode`, which no config here sets."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(Hydra, "get_mode", lambda *_, **__: None)
        yield


@pytest.fixture(scope="session")
def scans(tmp_path_factory):
    """Two drives with ground truth as a folder of .npy files."""
    root = tmp_path_factory.mktemp("scans")
    for name in ("0", "1"):
        drive = BoxSequence(name, FRAMES)
        (root / name).mkdir()
        for i, scan in enumerate(drive):
            np.save(root / name / f"{i}.npy", scan.points.numpy())
        write_kitti_poses(root / name / "poses.txt", drive.T_world_lidar)
    return root


@pytest.fixture(scope="session", autouse=True)
def no_plots():
    """Drawing takes longer than everything else."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(evaluate, "figures", lambda *_: iter(()))
        yield


@pytest.fixture
def call(monkeypatch, capsys, scans):
    """Runs evaluate.py on `scans` and returns its output."""

    def run(*arguments):
        monkeypatch.setattr(sys, "argv", ["evaluate.py", *arguments, "device=cpu", *on_scans(scans)])
        evaluate.main()
        return capsys.readouterr().out

    return run


@pytest.fixture(scope="session")
def finished_run(scans, tmp_path_factory):
    """The folder of an evaluation of two methods on both drives; tests must not write there."""
    folder = tmp_path_factory.mktemp("evaluations") / "finished"
    evaluate_scans(scans, folder, "methods=[cv+kd_f2m,ni]")
    return folder


@pytest.fixture
def run_copy(finished_run, tmp_path):
    """A copy of `finished_run`."""
    return shutil.copytree(finished_run, tmp_path / "run")


@pytest.fixture(scope="module")
def network(scans, tmp_path_factory):
    """A checkpoint that was trained on both drives, as far as it tells: its weights are random."""
    path = tmp_path_factory.mktemp("networks") / "network.ckpt"
    save_network(path, *on_scans(scans))
    return path
