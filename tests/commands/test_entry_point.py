"""An error that the user can fix is printed as one message; any other error keeps its stack trace."""

import sys

import pytest
from hydra.errors import InstantiationException
from hydra.utils import instantiate
from lightning.pytorch.utilities.exceptions import MisconfigurationException

from lidarlearn.commands import entry_point, mistakes
from lidarlearn.commands.entry_point import readable_message
from lidarlearn.errors import UserError
from tests.commands.configs import composed


def run(monkeypatch, tmp_path, *arguments, task=lambda config: None, program="data"):
    """Runs a task with the config of a program, by default with the smallest config."""
    monkeypatch.setattr(sys, "argv", [f"{program}.py", f"hydra.run.dir={tmp_path}/run", *arguments])
    monkeypatch.delenv("HYDRA_FULL_ERROR", raising=False)
    entry_point.run(task, program)


@pytest.mark.parametrize(
    ("program", "argument", "words"),
    [
        ("train", "data=kiti", ["no data=kiti; did you mean", "\n    kitti_00-08\n"]),
        ("train", "loss=weigthed_icp", ["did you mean loss=weighted_icp?", "\n    supervised\n"]),
        ("train", "dta=kitti_00-08", ["'dta'; did you mean", "\n    data\n"]),
        ("data", "data.rot=/x", ["'data.rot'; did you mean data.root?"]),
        ("train", "schedulers=cosine", ["did you mean scheduler?"]),
        ("train", "~callbacks.image", ["did you mean callbacks.images?"]),
        ("train", "ckpt=a=b.ckpt", ["ckpt=a=b.ckpt"]),
        ("train", "experiment=nothing", ["no experiment=nothing", "\n    kitti_04_mapping\n"]),
        ("train", "experiment=paper/kitty", ["did you mean experiment=paper/kitti?", "\n    paper/failures\n"]),
        ("train", "experiment=paper/kitti", ["change: that experiment is for evaluate.py"]),
        ("evaluate", "experiment=network/nclt", ["change: that experiment is for train.py"]),
        ("train", "logger@trainer.logger=x", ["logger@trainer.logger"]),
        (
            "train",
            "loss=null",
            ["no loss=null\n", "\n    supervised\n", "change: choose one of these, or leave loss=null out"],
        ),
        ("train", "+loss@module.loss=3", ["no loss=3\n", "or leave +loss@module.loss=3 out"]),
        (
            "train",
            "experiment=null",
            ["no experiment=null\n", "\n    kitti_04_mapping\n", "or leave experiment=null out"],
        ),
        (
            "data",
            "data.projection=vlp16",
            ["projection=vlp16 is a name, not a part", "change: projection@data.projection=vlp16"],
        ),
    ],
)
def test_typo_is_explained(monkeypatch, tmp_path, capsys, program, argument, words):
    with pytest.raises(SystemExit) as exit_:
        run(monkeypatch, tmp_path, argument, program=program)
    message = capsys.readouterr().err
    assert exit_.value.code == 1
    assert message.startswith("error: ") and "\n\n" not in message
    assert all(word in message for word in words), message
    assert "Traceback" not in message and "append" not in message


@pytest.mark.parametrize(
    ("program", "typo", "meant"),
    [
        ("train", "trainer.max_epoch", ["trainer.max_epochs"]),
        ("train", "batch_size", ["datamodule.batch_size"]),
        ("train", "loss.sigma", ["loss.sigma_m"]),
        (
            "evaluate",
            "local_map.k",
            [f"odometry.{a}_{m}.local_map.size" for a in ("p", "kd", "vh") for m in ("f2f", "f2m")],
        ),
    ],
)
def test_nearest_settings_are_suggested(program, typo, meant):
    assert mistakes.nearest(typo, mistakes._keys_below(composed(program))) == meant


def test_option_chosen_at_its_place_is_accepted(monkeypatch, tmp_path):
    run(monkeypatch, tmp_path, "projection@data.projection=vlp16")


def raises(error):
    def task(config):
        raise error

    return task


def test_user_error_prints_its_message(monkeypatch, tmp_path, capsys):
    with pytest.raises(SystemExit) as exit_:
        run(monkeypatch, tmp_path, task=raises(UserError("scan 3 is empty\n  change: data.root")))
    out = capsys.readouterr()
    assert exit_.value.code == 1
    assert out.err == "error: scan 3 is empty\n  change: data.root\n" and not out.out


def test_lightning_misconfiguration_prints_its_message(monkeypatch, tmp_path, capsys):
    with pytest.raises(SystemExit):
        run(monkeypatch, tmp_path, task=raises(MisconfigurationException("no logger")))
    assert capsys.readouterr().err == "error: no logger\n"


def test_other_error_keeps_its_stack_trace(monkeypatch, tmp_path):
    with pytest.raises(ZeroDivisionError):
        run(monkeypatch, tmp_path, task=raises(ZeroDivisionError("defect")))


def test_hydra_full_error_keeps_stack_trace_of_user_error(monkeypatch, tmp_path):
    monkeypatch.setattr(sys, "argv", ["data.py", f"hydra.run.dir={tmp_path}/run"])
    monkeypatch.setenv("HYDRA_FULL_ERROR", "1")
    with pytest.raises(UserError, match="scan 3"):
        entry_point.run(raises(UserError("scan 3 is empty")), "data")


def instantiation_error(node: dict) -> InstantiationException:
    with pytest.raises(InstantiationException) as raised:
        instantiate(node)
    return raised.value


def test_message_names_unknown_argument():
    node = {"_target_": "lidarlearn.geometry.projection.SphericalProjection", "hight": 3}
    assert "hight" in readable_message(instantiation_error(node), "evaluate")


def test_message_says_why_value_is_refused():
    node = {"_target_": "lidarlearn.geometry.projection.SphericalProjection", "height": 0}
    assert "height, width >= 1" in readable_message(instantiation_error(node), "evaluate")


def test_other_error_in_constructor_has_no_message():
    assert readable_message(instantiation_error({"_target_": "operator.truediv", "_args_": [1, 0]}), "evaluate") is None
