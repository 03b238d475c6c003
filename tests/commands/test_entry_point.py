"""Errors that the user can mend are one message; all others keep their stack trace."""

import sys

import pytest
from hydra.errors import InstantiationException
from hydra.utils import instantiate
from lightning.pytorch.utilities.exceptions import MisconfigurationException

from lidarlearn.commands import entry_point
from lidarlearn.commands.entry_point import readable_message
from lidarlearn.errors import UserError


def run(monkeypatch, tmp_path, *arguments, task=lambda config: None, program="train"):
    monkeypatch.setattr(sys, "argv", ["train.py", f"hydra.run.dir={tmp_path}/run", *arguments])
    monkeypatch.delenv("HYDRA_FULL_ERROR", raising=False)
    entry_point.run(task, program)


@pytest.mark.parametrize(
    ("argument", "words"),
    [
        ("data=kiti", ["no data=kiti; did you mean", "\n    kitti_00-08\n"]),
        ("loss=weigthed_icp", ["did you mean loss=weighted_icp?", "\n    supervised\n"]),
        ("dta=kitti_00-08", ["'dta'; did you mean", "\n    data\n"]),
        ("data.rot=/x", ["'data.rot'; did you mean data.root?"]),
        ("trainer.max_epoch=3", ["did you mean trainer.max_epochs?"]),
        ("batch_size=5", ["did you mean datamodule.batch_size?"]),
        ("schedulers=cosine", ["did you mean scheduler?"]),
        ("loss.sigma=0.2", ["did you mean loss.sigma_m?"]),
        ("~callbacks.image", ["did you mean callbacks.images?"]),
        ("ckpt=a=b.ckpt", ["ckpt=a=b.ckpt"]),
        ("experiment=nothing", ["no experiment=nothing", "\n    kitti_04_mapping\n"]),
        ("experiment=paper/kitty", ["did you mean experiment=paper/kitti?", "\n    paper/failures\n"]),
        ("experiment=paper/kitti", ["change: that experiment is for evaluate.py"]),
        ("logger@trainer.logger=x", ["logger@trainer.logger"]),
        ("loss=null", ["no loss=null\n", "\n    supervised\n", "change: choose one of these, or leave loss=null out"]),
        ("+loss@module.loss=3", ["no loss=3\n", "or leave +loss@module.loss=3 out"]),
        ("experiment=null", ["no experiment=null\n", "\n    kitti_04_mapping\n", "or leave experiment=null out"]),
    ],
)
def test_a_typo_is_a_readable_message(monkeypatch, tmp_path, capsys, argument, words):
    with pytest.raises(SystemExit) as exit_:
        run(monkeypatch, tmp_path, argument)
    message = capsys.readouterr().err
    assert exit_.value.code == 1
    assert message.startswith("error: ") and "\n\n" not in message
    assert all(word in message for word in words), message
    assert "Traceback" not in message and "append" not in message


@pytest.mark.parametrize(
    ("argument", "words"),
    [
        ("local_map.k=20", ["\n    odometry.kd_f2m.local_map.size\n"]),
        ("experiment=network/nclt", ["change: that experiment is for train.py"]),
        (
            "odometry.kd_f2m.registration.weight=huber",
            ["weight=huber is a name, not a part", "change: weight@odometry.kd_f2m.registration.weight=huber"],
        ),
    ],
)
def test_so_is_one_about_an_evaluation(monkeypatch, tmp_path, capsys, argument, words):
    with pytest.raises(SystemExit):
        run(monkeypatch, tmp_path, argument, program="evaluate")
    message = capsys.readouterr().err
    assert all(word in message for word in words), message


def test_a_part_chosen_by_its_name_is_none_of_these(monkeypatch, tmp_path):
    run(monkeypatch, tmp_path, "weight@odometry.kd_f2m.registration.weight=huber", program="evaluate")


def raises(error):
    def task(config):
        raise error

    return task


def test_a_user_error_is_its_message(monkeypatch, tmp_path, capsys):
    with pytest.raises(SystemExit) as exit_:
        run(monkeypatch, tmp_path, task=raises(UserError("scan 3 is empty\n  change: data.root")))
    out = capsys.readouterr()
    assert exit_.value.code == 1
    assert out.err == "error: scan 3 is empty\n  change: data.root\n" and not out.out


def test_what_lightning_cannot_do_is_its_message(monkeypatch, tmp_path, capsys):
    with pytest.raises(SystemExit):
        run(monkeypatch, tmp_path, task=raises(MisconfigurationException("no logger")))
    assert capsys.readouterr().err == "error: no logger\n"


def test_a_defect_keeps_its_stack_trace(monkeypatch, tmp_path):
    with pytest.raises(ZeroDivisionError):
        run(monkeypatch, tmp_path, task=raises(ZeroDivisionError("defect")))


def test_hydra_full_error_keeps_every_stack_trace(monkeypatch, tmp_path):
    monkeypatch.setattr(sys, "argv", ["train.py", f"hydra.run.dir={tmp_path}/run"])
    monkeypatch.setenv("HYDRA_FULL_ERROR", "1")
    with pytest.raises(UserError, match="scan 3"):
        entry_point.run(raises(UserError("scan 3 is empty")), "train")


def instantiation_error(node: dict) -> InstantiationException:
    with pytest.raises(InstantiationException) as raised:
        instantiate(node)
    return raised.value


def test_an_unknown_argument_is_named():
    node = {"_target_": "lidarlearn.geometry.projection.SphericalProjection", "hight": 3}
    assert "hight" in readable_message(instantiation_error(node), "evaluate")


def test_a_value_that_is_refused_says_why():
    node = {"_target_": "lidarlearn.geometry.projection.SphericalProjection", "height": 0}
    assert "height, width >= 1" in readable_message(instantiation_error(node), "evaluate")


def test_a_defect_within_a_constructor_is_no_matter_for_the_user():
    assert readable_message(instantiation_error({"_target_": "operator.truediv", "_args_": [1, 0]}), "evaluate") is None
