"""Scans over the whole range of steps and rates, and all lengths and sizes, against the loop, and
the gradients of the float64 forms against finite differences."""

from itertools import product

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from scans import (
    EXACT_PATHS,
    PATHS,
    RATES,
    SCANS,
    STEPS,
    assert_exact,
    both_ways,
    by_loop,
    errors,
    make_arguments,
)

CHUNKS = (32, 64, 128, 256)  # those of all back ends
LENGTHS = sorted({n for c in CHUNKS for n in (c, c + 1)} | {1, 17, 31, 63, 131, 515})
# The extremes of both, and all sizes of each with all sizes of the other.
CORNERS = [(steps, rates) for steps in (STEPS[0], STEPS[3]) for rates in (RATES[0], RATES[3])]
STEPS_AND_RATES = [*CORNERS, *product(STEPS[4:], RATES[4:]), ("1", "spread"), ("mixed", "1e-2")]


@pytest.mark.parametrize("path", EXACT_PATHS, ids="-".join)
def test_float64_forms_equal_the_loop(path, reverse):
    for steps in ("1", "spread"):
        arguments = [a.double() for a in make_arguments(path[0], 131, steps, "spread")]
        exact = by_loop(path, arguments, reverse=reverse)
        found = errors(both_ways(path, arguments, reverse=reverse), exact)
        assert max(found.values()) < 1e-12, (steps, found)


@pytest.mark.parametrize("steps, rates", STEPS_AND_RATES)
def test_every_step_and_rate(path, steps, rates, reverse):
    assert_exact(path, make_arguments(path[0], 131, steps, rates), reverse=reverse)


@pytest.mark.parametrize("steps, rates", [("1e-8", "1e4"), ("spread", "spread"), ("mixed", "1")])
def test_bfloat16_is_exact(path, steps, rates, reverse):
    arguments = make_arguments(path[0], 131, steps, rates, dtype=torch.bfloat16)
    assert_exact(path, arguments, reverse=reverse)


def test_float16_is_exact(path, reverse):
    assert_exact(path, make_arguments(path[0], 131, dtype=torch.float16), reverse=reverse)


@pytest.mark.medium
@pytest.mark.parametrize("path", PATHS, ids="-".join)
@settings(max_examples=20, derandomize=True, deadline=None)
@given(
    sizes=st.fixed_dictionaries(
        {
            "length": st.integers(1, 140),
            "steps": st.sampled_from(STEPS),
            "rates": st.sampled_from(RATES),
            "batch": st.integers(1, 3),
            "channels": st.integers(1, 4),
            "seed": st.integers(0, 10**6),
        }
    ),
    reverse=st.booleans(),
)
def test_any_sizes_steps_and_rates(path, sizes, reverse):
    assert_exact(path, make_arguments(path[0], **sizes), reverse=reverse, slack=2)


@pytest.mark.parametrize("length", LENGTHS)
def test_every_length_is_exact(path, length, reverse):
    assert_exact(path, make_arguments(path[0], length), reverse=reverse)


@pytest.mark.parametrize(
    "batch, channels, head_dim, state", [(1, 1, 1, 1), (3, 1, 5, 7), (1, 9, 1, 1), (3, 2, 33, 19)]
)
def test_every_size_is_exact(path, batch, channels, head_dim, state, reverse):
    arguments = make_arguments(
        path[0], 67, batch=batch, channels=channels, head_dim=head_dim, state=state
    )
    # A gradient of A that is one number may be a sum in which nearly all cancels.
    assert_exact(path, arguments, reverse=reverse, slack=2)


# Within a chunk, and over its end with steps that clear the state.
@pytest.mark.parametrize("length, steps", [(5, "0.1"), (66, "3")])
@pytest.mark.parametrize("path", EXACT_PATHS, ids="-".join)
def test_every_gradient_equals_finite_differences(path, length, steps, reverse):
    name, backend = path
    arguments = make_arguments(name, length, steps, batch=1, channels=2, head_dim=2, state=2)
    leaves = [argument.double().requires_grad_() for argument in arguments]
    assert torch.autograd.gradcheck(
        lambda *leaves: SCANS[name](*leaves, backend=backend, reverse=reverse),
        leaves,
        fast_mode=True,
    )
