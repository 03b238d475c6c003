"""The datamodule: which pairs reach the network, and how."""

from pathlib import Path

import pytest
import torch

from lidarlearn.commands.train import train
from lidarlearn.data.datamodule import OdometryDataModule
from lidarlearn.data.errors import DataSetNotFoundError
from lidarlearn.errors import UserError
from lidarlearn.geometry import se3
from tests.box_world import SMALL, BoxDrives
from tests.training.runs import configured


def make(tmp_path, drives=None, **settings):
    settings = {"batch_size": 4, "num_workers": 0, "preparation_workers": 0} | settings
    module = OdometryDataModule(drives or BoxDrives(frames=9), cache_root=str(tmp_path), **settings)
    module.prepare_data()
    module.setup()
    return module


def test_training_sees_every_pair_of_the_training_sequences_once_an_epoch(tmp_path):
    module = make(tmp_path)
    batches = list(module.train_dataloader())
    assert [len(b["index"]) for b in batches] == [4, 4, 4, 4]
    assert sorted(torch.cat([b["index"] for b in batches]).tolist()) == sorted([*range(8), *range(8)])


def test_training_pairs_are_shuffled(tmp_path):
    module = make(tmp_path)
    torch.manual_seed(0)
    epochs = [torch.cat([b["index"] for b in module.train_dataloader()]).tolist() for _ in range(2)]
    assert epochs[0] != epochs[1]


def test_validation_sequences_come_apart_and_in_order(tmp_path):
    module = make(tmp_path, BoxDrives(frames=9, val_sequences=("2", "4")))
    assert [s.name for s in module.val_sequences] == ["2", "4"]
    for loader in module.val_dataloader():
        assert torch.cat([b["index"] for b in loader]).tolist() == list(range(8))


def test_batches_are_decoded_to_metres(tmp_path):
    module = make(tmp_path)
    raw = next(iter(module.val_dataloader()[0]))
    batch = module.on_after_batch_transfer(raw, 0)
    assert raw["reference"].dtype == torch.int16 and batch["reference"].dtype == torch.float32
    exact = SMALL.vertex_map(module.data.sequence("2").scan(0).points)
    torch.testing.assert_close(batch["reference"][0], exact, atol=0.0021, rtol=0)
    expected = se3.relative(module.data.sequence("2").T_world_lidar)[:4]
    torch.testing.assert_close(batch["T_ref_new"], expected)


@pytest.mark.parametrize(
    ("height", "width", "expected"), [(None, None, (16, 96)), (8, None, (8, 96)), (8, 48, (8, 48))]
)
def test_the_network_s_image_may_be_smaller_than_the_data_set_s(tmp_path, height, width, expected):
    module = make(tmp_path, height=height, width=width)
    assert (module.projection.height, module.projection.width) == expected
    assert module.projection.fov_up_deg == SMALL.fov_up_deg
    assert next(iter(module.train_dataloader()))["reference"].shape == (4, 3, *expected)


def test_labels_are_left_out_where_one_sequence_has_none(tmp_path):
    module = make(tmp_path, BoxDrives(frames=9, without_truth=("1",)))
    assert all("T_ref_new" not in batch for batch in module.train_dataloader())
    assert "T_ref_new" in next(iter(module.val_dataloader()[0]))


@pytest.mark.filterwarnings(
    "ignore:This process:DeprecationWarning"
)  # fork beside torch's threads, from Python 3.12 on
def test_workers_load_the_same(tmp_path):
    plain, loaded = make(tmp_path), make(tmp_path, num_workers=2)
    for a, b in zip(plain.val_dataloader()[0], loaded.val_dataloader()[0], strict=True):
        torch.testing.assert_close(a["reference"], b["reference"])


class WithoutTheLast(BoxDrives):
    """Its last sequence, for validation, is not there."""

    def sequence(self, name):
        if name == self.val_sequences[-1]:
            raise DataSetNotFoundError("boxes", f"sequence {name}", Path("nowhere"), "a carpenter")
        return super().sequence(name)


def test_what_is_missing_is_told_before_anything_is_projected(tmp_path):
    with pytest.raises(DataSetNotFoundError, match="sequence 2"):
        make(tmp_path, WithoutTheLast(frames=9))
    assert not list(tmp_path.rglob("*.npy"))


def test_missing_labels_are_told_before_anything_is_projected(tmp_path):
    config = configured(tmp_path / "run", "loss=supervised", frames=9, without_truth=["1", "2"])
    with pytest.raises(UserError, match=r"there is none of 1, 2"):
        train(config, data_name="boxes")
    assert not list((tmp_path / "cache").rglob("*.npy"))


def test_nothing_to_train_on_is_an_error_that_names_the_setting(tmp_path):
    with pytest.raises(UserError, match=r"data\.train_sequences"):
        make(tmp_path, BoxDrives(frames=9, train_sequences=()))
