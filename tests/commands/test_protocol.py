"""What a result tells about how it came about."""

import json

import pytest
import torch
from hydra import compose, initialize_config_dir
from hydra.utils import instantiate

from lidarlearn.commands.configs import config_directory
from lidarlearn.commands.evaluate import configured_method
from lidarlearn.commands.protocol import ground_truth_digest, method_settings
from lidarlearn.commands.train import build_module
from lidarlearn.geometry import se3
from tests.box_world import BoxSequence
from tests.commands.scans import SENSOR

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


def trained(path, *overrides):
    """The checkpoint of a network that has yet to be trained; the names that it tells."""
    settings = ["device=cpu", "run_dir=x", *overrides]
    with initialize_config_dir(str(config_directory()), version_base="1.3"):
        config = compose("train", settings)
    module = build_module(config, instantiate(config.datamodule), "folder")
    parts = dict(module.hparams)
    content = {"module": f"{type(module).__module__}.{type(module).__qualname__}", "hyper_parameters": parts}
    torch.save({**content, "state_dict": module.state_dict()}, path)
    return parts["trained_on"]["train_sequences"]


def test_what_a_network_has_seen_is_told_by_the_names_that_its_data_set_made_of_the_settings(
    call, no_plots, scans, tmp_path
):
    checkpoint = tmp_path / "a.ckpt"
    assert trained(checkpoint, "data=kitti_00-08", "data.train_sequences=[3,10]") == ["03", "10"]
    assert trained(checkpoint, "data=folder", f"data.root={scans}", *SENSOR) == ["0", "1"]
    call(f"hydra.run.dir={tmp_path / 'run'}", f"ckpt={checkpoint}", "methods=[posenet]", "data.test_sequences=['1']")
    assert protocol(tmp_path / "run")["checkpoint"]["trained_on"]["train_sequences"] == ["0", "1"]
    assert "*: the network was trained on this sequence" in (tmp_path / "run" / "results.md").read_text()


def test_the_settings_of_a_method_are_all_that_its_result_depends_on():
    """Of a network counts what its file holds, not where it lies."""
    with initialize_config_dir(str(config_directory()), version_base="1.3"):
        config = compose("evaluate", ["device=cpu", "+networks.other=a.ckpt"])
    networks = {"other": {"sha256": "00ff"}}
    parts = {"other": (), "other+kd_f2m": ("odometry", "pipeline")}
    for name, others in parts.items():
        settings = method_settings(config, configured_method(config, name), networks)
        assert settings.keys() == {"deskew", "seed", "device", "initialization", "network", *others}
        assert settings["network"] == "00ff" and "network" not in settings["initialization"]


def test_what_a_drive_is_scored_against_is_told_by_what_matters_of_it():
    drive = BoxSequence("0", 6)
    digest = ground_truth_digest(drive)
    assert len(digest) == 16 and ground_truth_digest(BoxSequence("0", 6)) == digest
    drive.T_world_lidar = drive.T_world_lidar * (1 + 1e-15)
    assert ground_truth_digest(drive) == digest
    drive.T_world_lidar[-1, 0, 3] += 1e-3
    assert ground_truth_digest(drive) != digest
    camera = BoxSequence("0", 6)
    camera.T_reference_lidar = se3.exp(torch.full((6,), 1e-3, dtype=torch.float64))
    assert ground_truth_digest(camera) != digest
    assert ground_truth_digest(BoxSequence("0", 6, truth=False)) is None


def test_the_ground_truth_is_part_of_the_protocol(call, no_plots, tmp_path):
    call(f"hydra.run.dir={tmp_path}", "methods=[ni]", "data.test_sequences=['0','1']")
    digests = protocol(tmp_path)["ground_truth"]
    assert list(digests) == ["0", "1"] and all(len(digest) == 16 for digest in digests.values())
