"""`python train.py` as users call it."""

import os
import re
import shlex
import shutil
import signal
import subprocess
import sys
import time
from functools import partial
from pathlib import Path

import pytest
from lightning.pytorch.utilities import rank_zero_only
from lightning.pytorch.utilities.exceptions import SIGTERMException

from lidarlearn.commands import run_folder, train
from lidarlearn.commands.configs import config_directory
from lidarlearn.commands.run_folder import git_revision
from lidarlearn.commands.train import command_with
from lidarlearn.training.checkpoints import load_checkpoint
from tests.training.runs import configured, curves

TRAIN = Path(__file__).parents[2] / "train.py"
SMALL = (
    "data.frames=18", "data.train_sequences=[urban_00,urban_01]", "data.val_sequences=[urban_02]", "data.workers=0",
    "device=cpu", "datamodule.preparation_workers=0", "datamodule.batch_size=4", "datamodule.height=16",
    "datamodule.width=90", "datamodule.augmentation.mirror=false", "~callbacks.images",
)  # fmt: skip


def command(folder: Path, *arguments: str) -> list[str]:
    run = () if any(a.startswith("hydra.run.dir") for a in arguments) else (f"hydra.run.dir={folder}/run",)
    return [
        sys.executable, str(TRAIN), *SMALL, f"data.root={folder}/data", f"datamodule.cache_root={folder}/cache", *run,
        *arguments,
    ]  # fmt: skip


def environment() -> dict[str, str]:
    return {**os.environ, "OMP_NUM_THREADS": "1", "PYTHONPATH": str(TRAIN.parent)}


def call(folder: Path, *arguments: str) -> str:
    done = subprocess.run(command(folder, *arguments), env=environment(), capture_output=True, text=True, cwd=folder)
    assert done.returncode == 0, done.stderr
    return done.stdout + done.stderr


def test_config_directory_holds_train_config():
    assert (config_directory() / "train.yaml").is_file()


def test_git_revision_is_a_commit_or_unknown():
    assert re.fullmatch(r"[0-9a-f]{40}(-modified)?|unknown", git_revision())


def test_printed_command_repeats_data_overrides(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    overrides = ["data=folder", "data.root=/my scans", "trainer.max_epochs=1", "data.max_frames=9"]
    stored = command_with(tmp_path / "a.ckpt", "evaluate", overrides)
    assert stored == "lidarlearn-evaluate ckpt=a.ckpt 'data.root=/my scans'"
    not_stored = command_with(tmp_path / "a.ckpt", "evaluate", overrides, is_data_stored=False)
    assert not_stored == "lidarlearn-evaluate ckpt=a.ckpt data=folder 'data.root=/my scans' data.max_frames=9"


def test_git_revision_ignores_repository_around_installation(tmp_path, monkeypatch):
    def git(*arguments):
        subprocess.run(
            ["git", "-C", str(tmp_path), "-c", "user.name=a", "-c", "user.email=a@b", *arguments], check=True
        )

    installed = tmp_path / ".venv" / "lidarlearn" / "commands"
    shutil.copytree(Path(run_folder.__file__).parent, installed)
    monkeypatch.setattr(run_folder, "_SOURCE", installed)
    monkeypatch.setattr(run_folder, "__file__", str(installed / "run_folder.py"))
    git("init", "-q")
    git("commit", "-q", "--allow-empty", "-m", "of the project")
    assert git_revision() == "unknown"
    git("add", ".venv")
    git("commit", "-q", "-m", "a clone after all")
    commit = git_revision()
    assert re.fullmatch(r"[0-9a-f]{40}", commit)
    (installed / "run_folder.py").write_text("# changed")
    assert git_revision() == f"{commit}-modified"


@pytest.mark.parametrize(
    ("path", "printed"),
    [
        ("runs/a/best.ckpt", "ckpt=runs/a/best.ckpt"),
        ("runs/a b/best.ckpt", """'ckpt="runs/a b/best.ckpt"'"""),
        ("runs/lr=0.1,x/best.ckpt", """'ckpt="runs/lr=0.1,x/best.ckpt"'"""),
    ],
)
def test_printed_command_quotes_for_shell_and_hydra(path, printed, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert command_with(tmp_path / path, "evaluate") == f"lidarlearn-evaluate {printed}"
    assert command_with(tmp_path / path, "train") == f"lidarlearn-train {printed}"
    (tmp_path / "evaluate.py").touch()
    assert command_with(tmp_path / path, "evaluate") == f"python evaluate.py {printed}"


def test_second_process_accepts_checkpoints_of_the_first(tmp_path, monkeypatch):
    monkeypatch.setattr(rank_zero_only, "rank", 0)  # set by the trainer, restored after the test
    srun = {"NTASKS": 2, "NTASKS_PER_NODE": 2, "JOB_NAME": "a", "PROCID": 1, "LOCALID": 1, "NODEID": 0}
    for name, value in srun.items():
        monkeypatch.setenv(f"SLURM_{name}", str(value))
    (tmp_path / "run" / "checkpoints").mkdir(parents=True)
    (tmp_path / "run" / "checkpoints" / "last.ckpt").touch()
    monkeypatch.setattr(train, "build_module", lambda *_: pytest.exit("passed the checks"))
    config = configured(tmp_path / "run", "trainer.devices=2", "trainer.strategy=ddp")
    with pytest.raises(pytest.exit.Exception, match="passed the checks"):
        train.train(config, "boxes")


def test_printed_command_repeats_config_dir(tmp_path, monkeypatch, capsys):
    (tmp_path / "best.ckpt").touch()
    (tmp_path / "my configs").mkdir()
    monkeypatch.setattr(train, "train", lambda *_: tmp_path / "best.ckpt")
    monkeypatch.setattr(
        sys, "argv", ["train.py", f"hydra.run.dir={tmp_path}/run", "--config-dir", f"{tmp_path}/my configs"]
    )
    train.main()
    assert f"--config-dir '{tmp_path}/my configs' ckpt=" in capsys.readouterr().out


@pytest.mark.parametrize("events", [True, False])
def test_tensorboard_command_is_printed_only_with_events(tmp_path, monkeypatch, capsys, events):
    (tmp_path / "best.ckpt").touch()
    if events:
        (tmp_path / "run" / "version_0").mkdir(parents=True)
        (tmp_path / "run" / "version_0" / "events.out.tfevents.1").touch()
    monkeypatch.setattr(train, "train", lambda *_: tmp_path / "best.ckpt")
    monkeypatch.setattr(sys, "argv", ["train.py", f"hydra.run.dir={tmp_path}/run"])
    train.main()
    assert (f"tensorboard --logdir {tmp_path}/run" in capsys.readouterr().out) == events


@pytest.mark.parametrize("rank", [0, 1])
def test_only_first_process_prints_next_step(tmp_path, monkeypatch, capsys, rank):
    (tmp_path / "best.ckpt").touch()
    monkeypatch.setattr(rank_zero_only, "rank", rank)
    monkeypatch.setattr(train, "train", lambda *_: tmp_path / "best.ckpt")
    monkeypatch.setattr(sys, "argv", ["train.py", f"hydra.run.dir={tmp_path}/run"])
    train.main()
    assert capsys.readouterr().out.count("next:") == (rank == 0)


@pytest.mark.parametrize("is_saved", [True, False])
def test_interrupted_training_exits_with_error(tmp_path, monkeypatch, capsys, is_saved):
    last = tmp_path / "run" / "checkpoints" / "last.ckpt"

    def interrupted(*_):
        last.parent.mkdir(parents=True)
        if is_saved:
            last.touch()
        raise SIGTERMException

    monkeypatch.setattr(train, "train", interrupted)
    monkeypatch.setattr(sys, "argv", ["train.py", f"hydra.run.dir={tmp_path}/run", "data.root=/my/data"])
    with pytest.raises(SystemExit) as exit_:
        train.main()
    assert exit_.value.code == 1
    out = capsys.readouterr().out
    assert "interrupted" in out and "next:" not in out
    assert (f" ckpt={last} data.root=/my/data" in out) == is_saved


@pytest.mark.slow
def test_missing_data_prints_single_error(tmp_path):
    arguments = [
        "data=kitti_00-08",
        "loss=weighted_icp",
        f"data.root={tmp_path}/nowhere",
        f"hydra.run.dir={tmp_path}/run",
    ]
    done = subprocess.run(
        [sys.executable, str(TRAIN), *arguments], env=environment(), capture_output=True, text=True, cwd=tmp_path
    )
    assert done.returncode == 1
    assert "Traceback" not in done.stdout + done.stderr
    assert all(word in done.stderr for word in ("KITTI", "data.root", "nowhere", "http"))


@pytest.mark.slow
def test_training_prints_progress_and_next_step(tmp_path):
    out = call(tmp_path, "trainer.max_epochs=2")
    assert re.search(r"epoch 2/2 \[#+\] 100 %  loss [0-9.e-]+", out)
    assert "evaluate ckpt=run/checkpoints/best.ckpt" in out
    assert "Warning" not in out and "GPU available" not in out


@pytest.mark.slow
def test_killed_training_resumes_at_its_epoch(tmp_path):
    checkpoint = tmp_path / "run" / "checkpoints" / "last.ckpt"
    process = subprocess.Popen(
        command(tmp_path, "trainer.max_epochs=1000"), env=environment(), cwd=tmp_path, stdout=subprocess.DEVNULL
    )
    deadline = time.monotonic() + 300
    while not checkpoint.exists() and time.monotonic() < deadline and process.poll() is None:
        time.sleep(0.05)
    time.sleep(1.5)  # into some later epoch
    process.send_signal(signal.SIGKILL)
    process.wait()
    done = load_checkpoint(checkpoint)["epoch"] + 1
    out = call(tmp_path, f"trainer.max_epochs={done + 2}", f"ckpt={checkpoint}", f"hydra.run.dir={tmp_path}/resumed")
    assert [int(e) for e in re.findall(rf"epoch +(\d+)/{done + 2} .*100 %", out)] == [done + 1, done + 2]
    after = load_checkpoint(tmp_path / "resumed" / "checkpoints" / "last.ckpt")
    assert after["epoch"] == done + 1 and after["global_step"] == (done + 2) * 8


@pytest.mark.slow
@pytest.mark.parametrize("how", [signal.SIGINT, signal.SIGTERM])
def test_interrupted_training_prints_resume_command(tmp_path, how):
    shown = ("trainer.max_epochs=1000", "callbacks.progress.seconds_between_lines=0")
    process = subprocess.Popen(
        command(tmp_path, *shown),
        env=environment(),
        cwd=tmp_path,
        stdout=subprocess.PIPE,
        text=True,
        preexec_fn=partial(signal.signal, how, signal.SIG_DFL),  # shells let jobs in the background ignore SIGINT
    )
    assert process.stdout is not None
    next(line for line in process.stdout if re.match(r"epoch +2/1000 \[#+-", line))
    process.send_signal(how)
    out, _ = process.communicate()
    assert process.returncode == 1
    done = load_checkpoint(tmp_path / "run" / "checkpoints" / "last.ckpt")["epoch"] + 1
    printed = shlex.split(re.search(r"^go on: +lidarlearn-train (.*)$", out, re.MULTILINE)[1])
    again = call(tmp_path, *printed, f"trainer.max_epochs={done + 1}", f"hydra.run.dir={tmp_path}/resumed")
    assert re.findall(rf"epoch +(\d+)/{done + 1} .*100 %", again) == [str(done + 1)]


@pytest.mark.slow
def test_two_processes_train_like_one(tmp_path):
    """Same seed, one batch of all pairs: only its statistics within the network differ."""
    all_pairs = ("data.train_sequences=[urban_00]", "data.max_frames=9")
    shared = (*all_pairs, "trainer.max_epochs=3", "trainer.log_every_n_steps=1", "scheduler=constant")
    call(tmp_path, *shared, "datamodule.batch_size=8", f"hydra.run.dir={tmp_path}/one")
    two = ("trainer.devices=2", "trainer.strategy=ddp", f"hydra.run.dir={tmp_path}/two")
    out = call(tmp_path, *shared, "datamodule.batch_size=4", *two)
    a, b = curves(tmp_path / "one"), curves(tmp_path / "two")
    assert [step for step, _ in a["train/loss_epoch"]] == [step for step, _ in b["train/loss_epoch"]] == [0, 1, 2]
    of_one, of_two = ([value for _, value in scalars["train/loss_epoch"]] for scalars in (a, b))
    assert of_two[:2] == pytest.approx(of_one[:2], rel=0.05)  # small differences grow from step to step
    assert b["val/error"][-1][1] > 0
    assert out.count("next:") == 1
