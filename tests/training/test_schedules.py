"""Schedules of the learning rate."""

import pytest
import torch
from torch.optim import SGD

from lidarlearn.training.schedules import WarmUpCosine
from tests.training.runs import configured, curves


def rates(steps, **settings):
    optimizer = SGD([torch.zeros(1, requires_grad=True)], lr=2.0)
    schedule = WarmUpCosine(optimizer, **settings)
    seen = []
    for _ in range(steps):
        seen.append(schedule.get_last_lr()[0])
        optimizer.step()
        schedule.step()
    return seen


def test_rate_warms_up_and_falls_to_zero():
    seen = rates(101, total_steps=100, warm_up_share=0.2)
    assert seen[0] == pytest.approx(0.2) and seen[20] == 2.0 == max(seen)
    assert seen[:21] == sorted(seen[:21]) and seen[20:] == sorted(seen[20:], reverse=True)
    assert seen[60] == pytest.approx(1.0) and seen[100] == pytest.approx(0.0, abs=1e-12)


def test_rate_is_zero_beyond_last_step():
    assert rates(8, total_steps=4, warm_up_share=0.0)[5:] == [0.0, 0.0, 0.0]


def test_resumed_schedule_uses_new_number_of_steps():
    optimizer = SGD([torch.zeros(1, requires_grad=True)], lr=1.0)
    short, long = WarmUpCosine(optimizer, 4, 0.0), WarmUpCosine(optimizer, 8, 0.0)
    for _ in range(4):
        optimizer.step()
        short.step()
    long.load_state_dict(short.state_dict())
    optimizer.step()
    long.step()
    assert long.last_epoch == 5
    assert long.get_last_lr()[0] == pytest.approx(rates(6, total_steps=8, warm_up_share=0.0)[5] / 2)


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore::DeprecationWarning:tensorboard")
def test_training_updates_cosine_schedule_every_step(tmp_path):
    from lidarlearn.commands.train import train

    config = configured(
        tmp_path / "run", "trainer.max_epochs=2", "scheduler=cosine", "optimizer.lr=0.001",
        "trainer.log_every_n_steps=1", frames=17,
    )  # fmt: skip
    train(config, "boxes")
    lr = [value for _, value in curves(tmp_path / "run")["lr-Adam"]]
    assert len(lr) == 8  # two epochs of 32 pairs in batches of 8
    assert max(lr) == pytest.approx(1e-3, rel=0.1) and lr[-1] < 1e-4
