"""Errors that the user can mend are one message; all others keep their stack trace."""

import sys

import pytest
from hydra.errors import InstantiationException
from hydra.utils import instantiate
from lightning.pytorch.utilities.exceptions import MisconfigurationException

from lidarlearn.commands import entry_point
from lidarlearn.commands.entry_point import readable_message
from lidarlearn.errors import UserError


def run(monkeypatch, tmp_path, *arguments, task=lambda config: None):
    monkeypatch.setattr(sys, "argv", ["train.py", f"hydra.run.dir={tmp_path}/run", *arguments])
    monkeypatch.delenv("HYDRA_FULL_ERROR", raising=False)
    entry_point.run(task, "train")


@pytest.mark.parametrize(
    ("argument", "words"),
    [
        ("data=kiti", ["data/kiti", "kitti_00-08"]),
        ("loss=weigthed_icp", ["weigthed_icp", "weighted_icp", "supervised"]),
        ("dta=kitti_00-08", ["dta"]),
        ("data.rot=/x", ["data.rot"]),
        ("trainer.max_epoch=3", ["max_epoch"]),
        ("loss.sigma=0.2", ["sigma"]),
        ("ckpt=a=b.ckpt", ["ckpt=a=b.ckpt"]),
        ("experiment=nothing", ["experiment/nothing"]),
    ],
)
def test_a_typo_is_one_readable_line(monkeypatch, tmp_path, capsys, argument, words):
    with pytest.raises(SystemExit) as exit_:
        run(monkeypatch, tmp_path, argument)
    message = capsys.readouterr().err
    assert exit_.value.code == 1
    assert message.startswith("error: ") and len(message.strip().splitlines()) == 1
    assert all(word in message for word in words)
    assert "Traceback" not in message


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
    assert "hight" in readable_message(instantiation_error(node))


def test_a_value_that_is_refused_says_why():
    node = {"_target_": "lidarlearn.geometry.projection.SphericalProjection", "height": 0}
    assert "height, width >= 1" in readable_message(instantiation_error(node))


def test_a_defect_within_a_constructor_is_no_matter_for_the_user():
    assert readable_message(instantiation_error({"_target_": "operator.truediv", "_args_": [1, 0]})) is None
