"""Sequences as long as those of 32 images at 540x960, up to sixteen times that; few channels."""

import pytest
import torch
from scans import assert_exact, make_arguments

pytestmark = pytest.mark.medium

# A sum of 10,000 tokens or more, in a state or in the gradients of A and D, is rounded at each
# addition, and a float32 decay near 1 has few digits of its distance to 1: no form is within 2e-6.
SLACK = 3


def long_arguments(path, length, steps, rates="1"):
    return make_arguments(path[0], length, steps, rates, batch=1, channels=2, head_dim=1, state=2)


def test_long_sequences_are_exact(path, reverse):
    assert_exact(path, long_arguments(path, 65_280, "mixed"), reverse=reverse)


def test_a_quarter_of_a_million_steps_are_exact(path):
    assert_exact(path, long_arguments(path, 262_144, "1e-2"))


@pytest.mark.slow
@pytest.mark.parametrize("steps", ["1e-2", "mixed"])
def test_a_million_tokens_are_as_exact_as_sums_of_so_many_numbers(path, steps, reverse):
    assert_exact(path, long_arguments(path, 2**20, steps), reverse=reverse, slack=SLACK)


def test_slow_decay_over_a_long_sequence_is_exact(path):
    assert_exact(path, long_arguments(path, 65_280, "1e-8", "1e-4"), slack=SLACK)


def test_long_constants_are_exact(path):
    x, dt, A, B, C, D = (torch.ones_like(a) for a in long_arguments(path, 65_280, "1"))
    constants = (x, dt, -1e-4 * A, B, C, D)
    assert_exact(path, constants, torch.ones_like(x), slack=SLACK)
