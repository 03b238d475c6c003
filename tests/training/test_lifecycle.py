"""Trainings on a tiny world: run folders, checkpoints, resuming."""

import pytest
import torch

from lidarlearn.commands.train import train
from lidarlearn.errors import UserError
from lidarlearn.metrics.relative import relative_errors
from lidarlearn.training.checkpoints import load_checkpoint
from lidarlearn.training.module import PoseNetModule
from lidarlearn.training.supervised import SupervisedModule
from lidarlearn.training.unsupervised import UnsupervisedModule
from tests.box_world import SMALL, BoxDrives
from tests.training.runs import configured, curves, images, predicted

pytestmark = [
    pytest.mark.usefixtures("small_network"),
    pytest.mark.filterwarnings("ignore::DeprecationWarning:tensorboard"),
]
EPOCHS, FRAMES = 3, 33  # two drives of 32 pairs: eight batches of eight an epoch


LOSSES = ["weighted_icp", *(pytest.param(loss, marks=pytest.mark.slow) for loss in ("icp", "supervised"))]


@pytest.fixture(scope="module", params=LOSSES)
def run(request, tmp_path_factory, small_network):
    """A finished training with each of the losses."""
    folder = tmp_path_factory.mktemp(request.param) / "run"
    config = configured(folder, f"loss={request.param}", f"trainer.max_epochs={EPOCHS}", draws=True, frames=FRAMES)
    best = train(config, data_name="boxes")
    return folder, best, request.param


def test_run_folder_holds_checkpoints_config_revision_and_events(run):
    folder, best, _ = run
    assert best == folder / "checkpoints" / "best.ckpt"
    assert sorted(p.name for p in (folder / "checkpoints").iterdir()) == ["best.ckpt", "last.ckpt"]
    assert (folder / "config.yaml").read_text().count("PoseNet") >= 1
    assert (folder / "git_revision.txt").read_text().strip()
    assert list(folder.glob("events.out.tfevents*")) and not (folder / "hparams.yaml").exists()


def test_loss_falls(run):
    folder, _, loss = run
    # The supervised loss is not bounded below, its squared error is.
    tag = "translation_squared_m2" if loss == "supervised" else "loss"
    losses = [value for _, value in curves(folder)[f"train/{tag}_epoch"]]
    assert len(losses) == EPOCHS
    assert min(losses[1:]) < 0.9 * losses[0]


def test_curves_are_logged(run):
    folder, _, loss = run
    tags = curves(folder).keys()
    parts = {"s1", "s2"} if loss == "supervised" else {"activated_share", "residual_m"}
    assert {f"train/{part}_epoch" for part in parts} <= tags
    assert {"train/loss_step", "lr-Adam", "val/loss", "val/error", "val/mean_relative_translation_error_m"} <= tags


def test_images_and_trajectories_are_logged(run):
    tags = " ".join(images(run[0]))
    assert all(word in tags for word in ("vertex map", "normal map", "trajectory 2"))


def test_checkpoint_records_what_it_was_trained_on(run):
    _folder, best, loss = run
    trained_on = torch.load(best, weights_only=True)["hyper_parameters"]["trained_on"]
    assert trained_on["data_name"] == "boxes"
    assert trained_on["data"]["_target_"] == "tests.box_world.BoxDrives"
    assert loss.split("_")[0] in trained_on["loss"].lower()
    assert trained_on["projection"] == {"height": 16, "width": 96, "fov_up_deg": 15.0, "fov_down_deg": -20.0}
    assert {"git", "lidarlearn"} <= trained_on.keys()


def test_loaded_checkpoint_reproduces_logged_validation_error(run):
    folder, _, loss = run
    module = PoseNetModule.load_from_checkpoint(folder / "checkpoints" / "last.ckpt")
    assert isinstance(module, SupervisedModule if loss == "supervised" else UnsupervisedModule)
    sequence = BoxDrives(frames=FRAMES).sequence("2")
    T = predicted(folder / "checkpoints" / "last.ckpt", sequence)
    error = relative_errors(T, sequence.T_world_lidar).translation.mean()
    logged = curves(folder)["val/mean_relative_translation_error_m"][-1][1]
    assert float(error) == pytest.approx(logged, rel=1e-3)


def test_best_checkpoint_has_smallest_validation_error(run):
    folder, best, _ = run
    errors = [value for _, value in curves(folder)["val/error"]]
    assert load_checkpoint(best)["epoch"] == min(range(EPOCHS), key=errors.__getitem__)
    assert load_checkpoint(best.with_name("last.ckpt"))["epoch"] == EPOCHS - 1


def test_resuming_continues_at_next_epoch(run, tmp_path):
    folder, _best, loss = run
    config = configured(
        tmp_path / "resumed",
        f"loss={loss}",
        f"trainer.max_epochs={EPOCHS + 1}",
        f"ckpt={folder}/checkpoints/last.ckpt",
        frames=FRAMES,
    )
    train(config, data_name="boxes")
    after = load_checkpoint(tmp_path / "resumed" / "checkpoints" / "last.ckpt")
    assert after["epoch"] == EPOCHS
    assert after["global_step"] == (EPOCHS + 1) * 8
    steps = [step for step, _ in curves(tmp_path / "resumed")["train/loss_step"]]
    assert steps == list(range(EPOCHS * 8, (EPOCHS + 1) * 8))


def test_run_folder_of_another_training_is_refused(run, tmp_path):
    folder, best, loss = run
    for ckpt in ((), (f"ckpt={tmp_path}/elsewhere/last.ckpt",)):
        with pytest.raises(UserError, match=r"another training(.|\n)*hydra\.run\.dir(.|\n)*ckpt=.*last\.ckpt"):
            train(configured(folder, f"loss={loss}", *ckpt, frames=5), data_name="boxes")
    with pytest.raises(UserError, match="already seen"):  # resuming in its own folder is accepted
        train(configured(folder, f"loss={loss}", f"ckpt={best}", "trainer.max_epochs=1", frames=5), data_name="boxes")


@pytest.mark.parametrize(
    ("limit", "message"),
    [
        pytest.param(
            f"trainer.max_epochs={EPOCHS}",
            r"already seen 3 of 3 epochs\n  change: trainer\.max_epochs=6",
            id="max_epochs",
        ),
        pytest.param(
            "trainer.max_steps=20", r"already seen 24 of 20 steps\n  change: trainer\.max_steps=48", id="max_steps"
        ),
    ],
)
def test_resuming_a_finished_training_is_refused(run, tmp_path, limit, message):
    folder, _, loss = run
    checkpoint = folder / "checkpoints" / "last.ckpt"
    config = configured(tmp_path / "r", f"loss={loss}", limit, f"ckpt={checkpoint}", frames=5)
    with pytest.raises(UserError, match=message):
        train(config, data_name="boxes")


def test_resuming_with_another_model_is_refused(run, tmp_path):
    _folder, best, loss = run
    config = configured(tmp_path / "r", f"loss={loss}", "model.backbone=resnet34", f"ckpt={best}", frames=5)
    with pytest.raises(UserError, match="another model: backbone was resnet18"):
        train(config, data_name="boxes")


def resume_worse(folder, ended, run_dir, loss, **drives):
    """Resume for an epoch at a rate that ruins the network, from copied checkpoints; the best checkpoint."""
    last = folder / "checkpoints" / "last.ckpt"
    content = torch.load(last, weights_only=True)
    for group in content["optimizer_states"][0]["param_groups"]:
        group["lr"] = group["initial_lr"] = 1.0
    copied = ended / "checkpoints"
    copied.mkdir()
    torch.save(content, copied / "last.ckpt")
    (copied / "best.ckpt").write_bytes((folder / "checkpoints" / "best.ckpt").read_bytes())
    epoch = (f"trainer.max_epochs={EPOCHS + 1}", "+trainer.limit_train_batches=2")
    config = configured(run_dir, f"loss={loss}", f"ckpt={copied}/last.ckpt", *epoch, frames=FRAMES, **drives)
    return load_checkpoint(train(config, data_name="boxes"))


def test_resuming_keeps_best_checkpoint_if_later_epochs_are_worse(run, tmp_path):
    folder, best, loss = run
    after = resume_worse(folder, tmp_path, tmp_path / "resumed", loss)
    worse = curves(tmp_path / "resumed")["val/error"][0][1]
    assert worse > min(value for _, value in curves(folder)["val/error"])
    assert after["epoch"] == load_checkpoint(best)["epoch"]


def test_resuming_with_other_validation_drives_selects_best_anew(run, tmp_path):
    folder, _, loss = run
    assert resume_worse(folder, tmp_path, tmp_path / "resumed", loss, val_sequences=["1"])["epoch"] == EPOCHS


def test_resuming_with_other_training_drives_keeps_best_checkpoint(run, tmp_path):
    folder, best, loss = run
    after = resume_worse(folder, tmp_path, tmp_path, loss, train_sequences=["1"])  # in the same folder
    assert after["epoch"] == load_checkpoint(best)["epoch"]
    assert sorted(p.name for p in (tmp_path / "checkpoints").iterdir()) == ["best.ckpt", "last.ckpt"]


def test_resuming_renames_best_checkpoint_it_cannot_compare(run, tmp_path):
    folder, best, loss = run
    with pytest.warns(UserWarning, match=r"another way \(data\.val_sequences\)(.|\n)*best_before_epoch_004\.ckpt"):
        assert resume_worse(folder, tmp_path, tmp_path, loss, val_sequences=["1"])["epoch"] == EPOCHS
    assert (tmp_path / "checkpoints" / "best_before_epoch_004.ckpt").read_bytes() == best.read_bytes()


@pytest.mark.slow
def test_resuming_does_not_compare_misfit_with_loss(tmp_path):
    """Without ground truth, earlier versions selected by the loss, and did not record that."""
    drives = {"frames": 9, "without_truth": ["0", "2"]}
    train(configured(tmp_path, "trainer.max_epochs=1", **drives), data_name="boxes")
    checkpoints = tmp_path / "checkpoints"
    content = torch.load(checkpoints / "best.ckpt", weights_only=True)
    content["best_error"] = 0 * content["best_error"]
    torch.save(content, checkpoints / "best.ckpt")
    resumed = configured(tmp_path, "trainer.max_epochs=2", f"ckpt={checkpoints}/last.ckpt", **drives)
    assert load_checkpoint(train(resumed, data_name="boxes"))["epoch"] == 0
    del content["best_error_is"]
    torch.save(content, checkpoints / "best.ckpt")
    resumed = configured(tmp_path, "trainer.max_epochs=3", f"ckpt={checkpoints}/last.ckpt", **drives)
    with pytest.warns(UserWarning, match=r"another way \(error\)"):
        assert load_checkpoint(train(resumed, data_name="boxes"))["epoch"] == 2


def test_resident_maps_give_same_losses(tmp_path, capsys):
    losses = []
    for resident in ("true", "false"):
        config = configured(
            tmp_path / resident, "trainer.max_epochs=1", f"datamodule.resident={resident}", frames=9, val_sequences=[]
        )
        train(config, data_name="boxes")
        losses.append(curves(tmp_path / resident)["train/loss_step"])
    assert losses[0] == losses[1]
    assert capsys.readouterr().out.count("vertex maps to cpu: 18 scans") == 1


def test_same_seed_gives_same_losses(tmp_path):
    losses = []
    for name in ("a", "b"):
        config = configured(tmp_path / name, "trainer.max_epochs=1", "seed=7", frames=9)
        train(config, data_name="boxes")
        losses.append(curves(tmp_path / name)["train/loss_step"])
    assert losses[0] == losses[1]


def test_misfit_selects_best_checkpoint_without_ground_truth(tmp_path):
    config = configured(tmp_path / "run", "trainer.max_epochs=1", frames=9, without_truth=["0", "2"])
    best = train(config, data_name="boxes")
    scalars = curves(tmp_path / "run")
    assert best.name == "best.ckpt"
    assert scalars["val/error"] == scalars["val/misfit"]
    assert 0 < scalars["val/error"][0][1] < 1
    assert "val/mean_relative_translation_error_m" not in scalars


def test_supervised_training_requires_ground_truth(tmp_path):
    config = configured(tmp_path / "run", "loss=supervised", frames=9, without_truth=["0"])
    with pytest.raises(UserError, match=r"needs ground truth(.|\n)*train_sequences"):
        train(config, data_name="boxes")


def test_training_without_validation_returns_last_checkpoint(tmp_path):
    config = configured(tmp_path / "run", "trainer.max_epochs=1", frames=9, val_sequences=[])
    assert train(config, data_name="boxes").name == "last.ckpt"


def test_early_stopping_prints_its_reason(tmp_path, capsys):
    early = [
        "+callbacks.early._target_=lightning.pytorch.callbacks.EarlyStopping", "+callbacks.early.monitor=val/error",
        "+callbacks.early.stopping_threshold=1000",
    ]  # fmt: skip
    train(configured(tmp_path, *early, "trainer.max_epochs=2", frames=5), data_name="boxes")
    out = capsys.readouterr().out
    assert "epoch 2/2" not in out
    assert "EarlyStopping: Stopping threshold reached: val/error" in out.splitlines()[-1]


@pytest.mark.slow
def test_partial_validation_is_scored(tmp_path):
    config = configured(
        tmp_path / "run", "trainer.max_epochs=1", "+trainer.limit_train_batches=1", "trainer.limit_val_batches=2",
        frames=33,
    )  # fmt: skip
    train(config, data_name="boxes")
    assert curves(tmp_path / "run")["val/error"][0][1] > 0


@pytest.mark.slow
def test_training_without_any_overlap_warns(tmp_path):
    """The loss is zero then, and the misfit at its maximum."""
    config = configured(
        tmp_path / "run", "trainer.max_epochs=4", "optimizer.lr=0.3", frames=17, without_truth=["0", "2"]
    )
    with pytest.warns(UserWarning, match=r"so far off that(.|\n)*optimizer\.lr than 0\.3"):
        train(config, data_name="boxes")
    scalars = curves(tmp_path / "run")
    assert scalars["val/loss"][-1][1] < 1e-3 and scalars["val/error"][-1][1] > 0.99


@pytest.mark.slow
def test_sparse_vertex_maps_warn(tmp_path):
    config = configured(
        tmp_path / "run", "trainer.max_epochs=1", "datamodule.height=32", "datamodule.width=192", frames=9
    )
    with pytest.warns(UserWarning, match=r"% of the 32x192 pixels(.|\n)*datamodule\.height"):
        train(config, data_name="boxes")


@pytest.mark.slow
def test_training_in_bf16(tmp_path):
    config = configured(tmp_path / "run", "trainer.max_epochs=1", "trainer.precision=bf16-mixed", frames=9)
    train(config, data_name="boxes")
    assert curves(tmp_path / "run")["train/loss_epoch"][0][1] < 1


def test_loaded_module_has_projection_and_is_in_evaluation_mode(run):
    module = PoseNetModule.load_from_checkpoint(run[1])
    assert module.projection == SMALL and not module.training
