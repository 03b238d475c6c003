"""The datamodule: batches of pairs, their labels, and where their maps are kept."""

from pathlib import Path
from types import SimpleNamespace

import pytest
import torch

from lidarlearn.commands.train import train
from lidarlearn.data.augmentation import Augmentation
from lidarlearn.data.datamodule import OdometryDataModule
from lidarlearn.data.errors import DataSetNotFoundError
from lidarlearn.errors import UserError
from lidarlearn.geometry import se3
from tests.box_world import SMALL, BoxDrives
from tests.gpu import on_gpu
from tests.training.runs import configured


@pytest.fixture(scope="module")
def cache_root(tmp_path_factory):
    """Vertex maps are projected once for all tests."""
    return tmp_path_factory.mktemp("vertex_maps")


def make(cache_root, drives=None, **settings):
    settings = {"batch_size": 4, "num_workers": 0, "preparation_workers": 0} | settings
    module = OdometryDataModule(drives or BoxDrives(frames=9), cache_root=str(cache_root), **settings)
    module.prepare_data()
    module.setup()
    module.keep_maps_on(torch.device("cpu"))
    return module


def test_epoch_has_each_training_pair_once(cache_root):
    module = make(cache_root)
    batches = list(module.train_dataloader())
    assert [len(b["index"]) for b in batches] == [4, 4, 4, 4]
    assert sorted(torch.cat([b["index"] for b in batches]).tolist()) == sorted([*range(8), *range(8)])


def test_small_share_of_process_keeps_incomplete_batch(cache_root):
    module = make(cache_root, BoxDrives(frames=7, train_sequences=("0",)))
    assert len(module.train_dataloader()) == 1  # a batch of four; the other two pairs are dropped
    module.trainer = SimpleNamespace(world_size=2)
    assert not module.train_dataloader().drop_last  # three pairs each


def test_training_pairs_are_shuffled(cache_root):
    module = make(cache_root)
    torch.manual_seed(0)
    epochs = [torch.cat([b["index"] for b in module.train_dataloader()]).tolist() for _ in range(2)]
    assert epochs[0] != epochs[1]


def test_each_validation_sequence_has_ordered_loader(cache_root):
    module = make(cache_root, BoxDrives(frames=9, val_sequences=("2", "4")))
    assert [s.name for s in module.val_sequences] == ["2", "4"]
    for loader in module.val_dataloader():
        assert torch.cat([b["index"] for b in loader]).tolist() == list(range(8))


def test_batches_are_decoded_to_metres_after_transfer(cache_root):
    module = make(cache_root)
    raw = next(iter(module.val_dataloader()[0]))
    batch = module.on_after_batch_transfer(raw, 0)
    assert raw["reference"].dtype == torch.int16 and batch["reference"].dtype == torch.float32
    exact = SMALL.vertex_map(module.data.sequence("2").scan(0).points)
    torch.testing.assert_close(batch["reference"][0], exact, atol=0.0021, rtol=0)
    expected = se3.relative(module.data.sequence("2").T_world_lidar)[:4]
    torch.testing.assert_close(batch["T_ref_new"], expected)


@pytest.mark.parametrize(
    ("height", "width", "expected"), [(None, None, (16, 96)), (8, None, (8, 96)), (8, 48, (8, 48))], ids=str
)
def test_image_size_may_differ_from_data_set(cache_root, height, width, expected):
    module = make(cache_root, height=height, width=width)
    assert (module.projection.height, module.projection.width) == expected
    assert module.projection.fov_up_deg == SMALL.fov_up_deg
    assert next(iter(module.train_dataloader()))["reference"].shape == (4, 3, *expected)


def test_one_sequence_without_poses_removes_labels(cache_root):
    module = make(cache_root, BoxDrives(frames=9, without_truth=("1",)))
    assert all("T_ref_new" not in batch for batch in module.train_dataloader())
    assert "T_ref_new" in next(iter(module.val_dataloader()[0]))


ALL_CHANGES = Augmentation(mirror=True, turn=True, reverse=True, max_skip=3, drop_out=0.3)


@pytest.mark.parametrize("augmentation", [None, ALL_CHANGES], ids=["plain", "augmented"])
def test_resident_maps_give_equal_batches(cache_root, augmentation):
    modules = [make(cache_root, resident=resident, augmentation=augmentation) for resident in (False, True)]
    trained, validated = [], []
    for module in modules:
        torch.manual_seed(0)
        trained.append([module.completed(batch, augmented=True) for batch in module.train_dataloader()])
        validated.append([module.completed(batch, augmented=False) for batch in module.val_dataloader()[0]])
    for batches in (trained, validated):
        for read, looked_up in zip(*batches, strict=True):
            assert read.keys() == looked_up.keys() == {"reference", "target", "index", "T_ref_new"}
            assert all(torch.equal(read[key], looked_up[key]) for key in read)
    assert next(iter(modules[1].train_dataloader()))["reference"].shape == (4,)  # indices of maps
    modules[1].teardown()
    assert next(iter(modules[1].train_dataloader()))["reference"].shape == (4, 3, 16, 96)


def test_augmentation_applies_in_training_only(cache_root):
    plain, augmented = make(cache_root), make(cache_root, augmentation=ALL_CHANGES)
    for is_training in (False, True):
        augmented.trainer = SimpleNamespace(training=is_training)
        for batches in zip(plain.val_dataloader()[0], augmented.val_dataloader()[0], strict=True):
            one, other = plain.on_after_batch_transfer(batches[0], 0), augmented.on_after_batch_transfer(batches[1], 0)
            assert all(torch.equal(one[key], other[key]) for key in one) != is_training


@pytest.mark.parametrize(("resident", "is_kept"), [("auto", False), (True, True), (False, False)])
def test_maps_are_resident_on_cpu_only_if_requested(cache_root, resident, is_kept):
    rows = next(iter(make(cache_root, resident=resident).val_dataloader()[0]))["reference"]
    assert (rows.dim() == 1) == is_kept


@pytest.mark.parametrize(("free", "is_kept"), [(3.0, True), (1.5, False)])
def test_maps_are_resident_if_below_half_of_free_memory(cache_root, monkeypatch, free, is_kept):
    module = make(cache_root)
    monkeypatch.setattr("lidarlearn.data.datamodule._free_memory", lambda _: int(free * module._maps.nbytes))
    module.keep_maps_on(torch.device("cpu"))
    assert (next(iter(module.val_dataloader()[0]))["reference"].dim() == 1) == is_kept


def test_full_disk_is_refused_before_projection(tmp_path, monkeypatch):
    one = 9 * 3 * SMALL.height * SMALL.width * 2
    usage = SimpleNamespace(free=50_000_000 + 2 * one)
    monkeypatch.setattr("lidarlearn.data.cache.shutil.disk_usage", lambda _: usage)
    with pytest.raises(UserError, match=r"datamodule\.cache_root"):
        make(tmp_path)  # three sequences
    assert not list(tmp_path.rglob("vertex_maps.npy"))


def test_out_of_memory_error_names_setting(cache_root, monkeypatch):
    def full(*_, **__):
        raise torch.OutOfMemoryError("CUDA out of memory")

    module = make(cache_root)
    module.resident = True
    monkeypatch.setattr("lidarlearn.data.cache.VertexMaps.to", full)
    with pytest.raises(UserError, match=r"do not fit into the memory of cpu(.|\n)*datamodule\.resident=false"):
        module.keep_maps_on(torch.device("cpu"))


def test_invalid_resident_setting_is_refused(cache_root):
    with pytest.raises(ValueError, match="true, false or auto, got 'always'"):
        make(cache_root, resident="always")


# fork beside torch's threads, from Python 3.12 on
@pytest.mark.filterwarnings("ignore:This process:DeprecationWarning")
def test_workers_load_equal_batches(cache_root):
    plain, loaded = make(cache_root), make(cache_root, num_workers=2)
    for a, b in zip(plain.val_dataloader()[0], loaded.val_dataloader()[0], strict=True):
        torch.testing.assert_close(a["reference"], b["reference"])


@pytest.mark.filterwarnings("ignore:This process:DeprecationWarning")
@pytest.mark.parametrize("num_workers", [0, 2])
def test_validation_leaves_random_state_unchanged(cache_root, num_workers):
    """Otherwise the batches of the next epoch would depend on how often workers were started."""
    module = make(cache_root, num_workers=num_workers)
    state = torch.get_rng_state()
    list(module.val_dataloader()[0])
    assert torch.equal(state, torch.get_rng_state())


class LastSequenceMissing(BoxDrives):
    """The sequence for validation is missing."""

    def sequence(self, name):
        if name == self.val_sequences[-1]:
            raise DataSetNotFoundError("boxes", f"sequence {name}", Path("nowhere"), "a carpenter")
        return super().sequence(name)


def test_missing_sequence_is_reported_before_projection(tmp_path):
    with pytest.raises(DataSetNotFoundError, match="sequence 2"):
        make(tmp_path, LastSequenceMissing(frames=9))
    assert not list(tmp_path.rglob("*.npy"))


def test_missing_labels_are_reported_before_projection(tmp_path):
    config = configured(tmp_path / "run", "loss=supervised", frames=9, without_truth=["1", "2"])
    with pytest.raises(UserError, match=r"there is none of 1, 2"):
        train(config, data_name="boxes")
    assert not list((tmp_path / "cache").rglob("*.npy"))


def test_empty_training_split_error_names_setting(cache_root):
    with pytest.raises(UserError, match=r"data\.train_sequences"):
        make(cache_root, BoxDrives(frames=9, train_sequences=()))


@on_gpu
def test_maps_on_gpu_give_equal_batches(cache_root):
    batches = []
    for device in ("cpu", "cuda"):
        module = make(cache_root)
        module.keep_maps_on(torch.device(device))
        torch.manual_seed(0)
        batch = next(iter(module.train_dataloader()))
        batches.append(module.completed({key: value.to(device) for key, value in batch.items()}, augmented=False))
    assert batches[1]["reference"].is_cuda
    assert all(torch.equal(batches[0][key], batches[1][key].cpu()) for key in batches[0])
