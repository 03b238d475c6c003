"""Loading checkpoints: errors of files that are none, and safety of foreign ones."""

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
    """Unpickling it creates a file."""

    def __init__(self, path):
        self.path = path

    def __reduce__(self):
        return open, (str(self.path), "w")


def test_missing_file_is_reported(tmp_path):
    with pytest.raises(CheckpointError, match=r"nothing\.ckpt: no such file(.|\n)*change: ckpt="):
        load_checkpoint(tmp_path / "nothing.ckpt")


@pytest.mark.parametrize("content", [b"", b"not a checkpoint", b"PK\x03\x04 broken"], ids=["empty", "text", "zip"])
def test_damaged_file_is_reported(tmp_path, content):
    (tmp_path / "a.ckpt").write_bytes(content)
    with pytest.raises(CheckpointError, match=r"damaged|refused"):
        load_checkpoint(tmp_path / "a.ckpt")


def test_truncated_checkpoint_is_reported(tmp_path):
    path = tmp_path / "a.ckpt"
    torch.save({"state_dict": torch.zeros(1000)}, path)
    path.write_bytes(path.read_bytes()[:500])
    with pytest.raises(CheckpointError, match="damaged"):
        load_checkpoint(path)


def test_checkpoint_of_another_project_is_refused(tmp_path):
    torch.save({"state_dict": {}}, tmp_path / "a.ckpt")
    with pytest.raises(CheckpointError, match="not written by lidarlearn"):
        load_checkpoint(tmp_path / "a.ckpt")


@pytest.mark.parametrize("missing", ["model", "trained_on"])
def test_checkpoint_with_missing_hyperparameters_is_refused(tmp_path, missing):
    parts = {key: value for key, value in PARTS.items() if key != missing}
    torch.save({"module": "x", "hyper_parameters": parts, "state_dict": {}}, tmp_path / "a.ckpt")
    with pytest.raises(CheckpointError, match="not written by lidarlearn"):
        load_checkpoint(tmp_path / "a.ckpt")


def test_weights_that_do_not_fit_the_model_are_reported(tmp_path):
    torch.save({"module": "x", "hyper_parameters": PARTS, "state_dict": {}}, tmp_path / "a.ckpt")
    with pytest.raises(CheckpointError, match="weights do not fit"):
        load_trained_network(tmp_path / "a.ckpt")


@pytest.mark.parametrize(
    "save", [torch.save, lambda data, path: path.write_bytes(pickle.dumps(data, protocol=2))], ids=["torch", "pickle"]
)
def test_pickled_code_is_not_run(tmp_path, save):
    save({"state_dict": {}, "x": Attack(tmp_path / "trace")}, tmp_path / "a.ckpt")
    with pytest.raises(CheckpointError, match="refused"):
        load_checkpoint(tmp_path / "a.ckpt")
    assert not (tmp_path / "trace").exists()


@pytest.mark.parametrize("part", ["model", "loss", "module"])
def test_untrusted_targets_are_not_built(tmp_path, part):
    parts = {**PARTS, part: {"_target_": "pathlib.Path"}}
    module = parts.pop("module", {"_target_": "lidarlearn.training.unsupervised.UnsupervisedModule"})["_target_"]
    torch.save({"module": module, "hyper_parameters": parts, "state_dict": {}}, tmp_path / "a.ckpt")
    with pytest.raises(UntrustedTargetError, match=r"pathlib\.Path"):
        PoseNetModule.load_from_checkpoint(tmp_path / "a.ckpt")
