"""The learning rate of every step: up to the optimizer's own, then down to 0."""

import math

import pytest
import torch

from asysplat.training.schedule import cosine


def rates(warmup_steps, total_steps, steps):
    optimizer = torch.optim.SGD([torch.zeros(1, requires_grad=True)], lr=0.4)
    schedule = cosine(optimizer, warmup_steps, total_steps)
    found = []
    for _ in range(steps):
        found += schedule.get_last_lr()
        optimizer.step()
        schedule.step()
    return found


def test_linear_warm_up_then_a_cosine_to_zero():
    found = rates(warmup_steps=4, total_steps=12, steps=15)
    assert found[:5] == pytest.approx([0.1, 0.2, 0.3, 0.4, 0.4])
    assert found[6] == pytest.approx(0.2 * (1 + math.cos(math.pi / 4)))
    assert found[8] == pytest.approx(0.2)
    assert found[12:] == [0.0, 0.0, 0.0]


def test_without_a_warm_up_the_first_step_has_the_highest_rate():
    found = rates(warmup_steps=0, total_steps=3, steps=3)
    assert found == pytest.approx([0.4, 0.3, 0.1])


def test_a_warm_up_of_the_whole_training():
    assert rates(warmup_steps=2, total_steps=2, steps=3) == pytest.approx([0.2, 0.4, 0.4])
