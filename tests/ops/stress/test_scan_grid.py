"""Scans over the whole range of steps and rates, and all lengths and sizes, against the loop, and
the gradients of the float64 forms against finite differences."""

import pytest
import torch
from scans import (
    EXACT_PATHS,
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
LENGTHS = sorted({n for c in CHUNKS for n in (c - 1, c, c + 1, 2 * c + 3)} | {1, 17})


@pytest.mark.parametrize("path", EXACT_PATHS, ids="-".join)
@pytest.mark.parametrize("steps", ["1", "spread"])
def test_float64_forms_and_the_loop(path, steps, reverse):
    arguments = [a.double() for a in make_arguments(path[0], 131, steps, "spread")]
    exact = by_loop(path, arguments, reverse=reverse)
    assert max(errors(both_ways(path, arguments, reverse=reverse), exact).values()) < 1e-12


@pytest.mark.parametrize("rates", RATES)
@pytest.mark.parametrize("steps", STEPS)
def test_every_step_and_rate(path, steps, rates, reverse):
    assert_exact(path, make_arguments(path[0], 131, steps, rates), reverse=reverse)


@pytest.mark.parametrize("rates", RATES)
@pytest.mark.parametrize("steps", STEPS)
def test_every_step_and_rate_in_bfloat16(path, steps, rates):
    assert_exact(path, make_arguments(path[0], 131, steps, rates, dtype=torch.bfloat16))


@pytest.mark.parametrize("length", LENGTHS)
def test_every_length(path, length, reverse):
    assert_exact(path, make_arguments(path[0], length), reverse=reverse)


def test_half_precision(path, reverse):
    arguments = make_arguments(path[0], 131, dtype=torch.float16)
    assert_exact(path, arguments, reverse=reverse)


@pytest.mark.parametrize("batch", [1, 3])
@pytest.mark.parametrize(
    "channels, head_dim, state", [(1, 1, 1), (1, 1, 7), (1, 5, 1), (9, 1, 1), (2, 33, 19)]
)
def test_every_size(path, batch, channels, head_dim, state, reverse):
    arguments = make_arguments(
        path[0], 67, batch=batch, channels=channels, head_dim=head_dim, state=state
    )
    # A gradient of A that is one number may be a sum in which nearly all cancels.
    assert_exact(path, arguments, reverse=reverse, slack=2)


# Within a chunk, over its end, and with steps that clear the state.
CASES = {"short": (5, "0.1"), "long": (66, "0.1"), "forgetful": (66, "3")}


@pytest.mark.parametrize("case", CASES)
@pytest.mark.parametrize("path", EXACT_PATHS, ids="-".join)
def test_every_gradient_equals_finite_differences(path, case, reverse):
    name, backend = path
    length, steps = CASES[case]
    arguments = make_arguments(name, length, steps, batch=1, channels=2, head_dim=2, state=2)
    leaves = [argument.double().requires_grad_() for argument in arguments]
    assert torch.autograd.gradcheck(
        lambda *leaves: SCANS[name](*leaves, backend=backend, reverse=reverse),
        leaves,
        fast_mode=True,
    )
