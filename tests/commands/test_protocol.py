"""The record of how a result was obtained."""

import json

import pytest
import torch

from lidarlearn.commands.evaluate import configured_method
from lidarlearn.commands.protocol import ground_truth_digest, method_settings
from lidarlearn.errors import UserError
from lidarlearn.geometry import se3
from tests.box_world import BoxSequence
from tests.commands.configs import composed
from tests.commands.networks import save_network
from tests.commands.scans import evaluate_scans

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


def test_protocol_names_scored_files_and_their_frame(scans, foreign, tmp_path):
    evaluate_scans(scans, tmp_path / "run", f"trajectories={foreign}", "data.test_sequences=['0']")
    assert protocol(tmp_path / "run")["trajectories"] == {"path": str(foreign), "frame": "lidar"}


def test_trajectories_together_with_methods_are_refused(scans, foreign, tmp_path):
    with pytest.raises(UserError, match=rf"{foreign}.*ei\+kd_f2m(.|\n)*methods=null"):
        evaluate_scans(scans, tmp_path / "run", f"trajectories={foreign}", "methods=[ei+kd_f2m]")


def test_checkpoint_names_sequences_as_its_data_set_does(network, tmp_path):
    kitti = save_network(tmp_path / "kitti.ckpt", "data=kitti_00-08", "data.train_sequences=[3,10]")
    assert kitti == ["03", "10"]
    in_folder = torch.load(network, weights_only=True)["hyper_parameters"]["trained_on"]["train_sequences"]
    assert in_folder == ["0", "1"]  # all, since `data.train_sequences` is null


def test_protocol_names_training_sequences_of_checkpoint(scans, network, tmp_path):
    evaluate_scans(scans, tmp_path, f"ckpt={network}", "methods=[posenet]", "data.test_sequences=['1']")
    assert protocol(tmp_path)["checkpoint"]["trained_on"]["train_sequences"] == ["0", "1"]
    assert "*: the network was trained on this sequence" in (tmp_path / "results.md").read_text()


def test_method_settings_hold_the_hash_of_a_network_and_not_its_path():
    config = composed("evaluate", "device=cpu", "+networks.other=a.ckpt")
    networks = {"other": {"sha256": "00ff"}}
    parts = {"other": (), "other+kd_f2m": ("odometry", "pipeline")}
    for name, others in parts.items():
        settings = method_settings(config, configured_method(config, name), networks)
        assert settings.keys() == {"deskew", "seed", "device", "initialization", "network", *others}
        assert settings["network"] == "00ff" and "network" not in settings["initialization"]


def test_ground_truth_digest_changes_with_poses_beyond_rounding():
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


def test_protocol_holds_ground_truth_digests(finished_run):
    digests = protocol(finished_run)["ground_truth"]
    assert list(digests) == ["0", "1"] and all(len(digest) == 16 for digest in digests.values())
