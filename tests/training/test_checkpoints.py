"""Files that are no checkpoint of ours."""

import pickle

import pytest
import torch

from lidarlearn.training.checkpoints import CheckpointError, load_checkpoint
from lidarlearn.training.module import PoseNetModule
from lidarlearn.training.parts import UntrustedTargetError
from lidarlearn.training.trained_network import load_trained_network

PARTS = {
    "model": {"_target_": "lidarlearn.models.posenet.PoseNet"},
    "loss": {"_target_": "lidarlearn.losses.icp.IcpLoss"},
    "optimizer": {"_target_": "torch.optim.Adam"},
    "scheduler": {"_target_": "torch.optim.lr_scheduler.StepLR", "step_size": 1},
    "trained_on": {
        "data": {},
        "data_name": "x",
        "loss": "IcpLoss",
        "git": "unknown",
        "projection": {"height": 16, "width": 32, "fov_up_deg": 3.0, "fov_down_deg": -24.0},
    },
}


class Attack:
    """Unpickling it would make a file."""

    def __init__(self, path):
        self.path = path

    def __reduce__(self):
        return open, (str(self.path), "w")


def test_a_missing_file(tmp_path):
    with pytest.raises(CheckpointError, match=r"nothing\.ckpt: no such file(.|\n)*change: ckpt="):
        load_checkpoint(tmp_path / "nothing.ckpt")


@pytest.mark.parametrize("content", [b"", b"not a checkpoint", b"PK\x03\x04 broken"])
def test_a_damaged_file(tmp_path, content):
    (tmp_path / "a.ckpt").write_bytes(content)
    with pytest.raises(CheckpointError, match=r"damaged|refused"):
        load_checkpoint(tmp_path / "a.ckpt")


def test_a_truncated_checkpoint(tmp_path):
    path = tmp_path / "a.ckpt"
    torch.save({"state_dict": torch.zeros(1000)}, path)
    path.write_bytes(path.read_bytes()[:500])
    with pytest.raises(CheckpointError, match="damaged"):
        load_checkpoint(path)


def test_a_file_of_another_project(tmp_path):
    torch.save({"state_dict": {}}, tmp_path / "a.ckpt")
    with pytest.raises(CheckpointError, match="not written by lidarlearn"):
        load_checkpoint(tmp_path / "a.ckpt")


@pytest.mark.parametrize("missing", ["model", "trained_on"])
def test_a_checkpoint_that_does_not_tell_all(tmp_path, missing):
    parts = {key: value for key, value in PARTS.items() if key != missing}
    torch.save({"module": "x", "hyper_parameters": parts, "state_dict": {}}, tmp_path / "a.ckpt")
    with pytest.raises(CheckpointError, match="not written by lidarlearn"):
        load_checkpoint(tmp_path / "a.ckpt")


def test_weights_of_another_model(tmp_path):
    torch.save({"module": "x", "hyper_parameters": PARTS, "state_dict": {}}, tmp_path / "a.ckpt")
    with pytest.raises(CheckpointError, match="weights do not fit"):
        load_trained_network(tmp_path / "a.ckpt")


@pytest.mark.parametrize("save", [torch.save, lambda data, path: path.write_bytes(pickle.dumps(data, protocol=2))])
def test_no_code_of_a_file_is_run(tmp_path, save):
    save({"state_dict": {}, "x": Attack(tmp_path / "trace")}, tmp_path / "a.ckpt")
    with pytest.raises(CheckpointError, match="refused"):
        load_checkpoint(tmp_path / "a.ckpt")
    assert not (tmp_path / "trace").exists()


@pytest.mark.parametrize("part", ["model", "loss", "module"])
def test_no_foreign_class_is_built(tmp_path, part):
    parts = {**PARTS, part: {"_target_": "pathlib.Path"}}
    module = parts.pop("module", {"_target_": "lidarlearn.training.unsupervised.UnsupervisedModule"})["_target_"]
    torch.save({"module": module, "hyper_parameters": parts, "state_dict": {}}, tmp_path / "a.ckpt")
    with pytest.raises(UntrustedTargetError, match=r"pathlib\.Path"):
        PoseNetModule.load_from_checkpoint(tmp_path / "a.ckpt")
