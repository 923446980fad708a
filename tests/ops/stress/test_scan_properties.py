"""Properties of any scan: linearity, permutations, reversal, and splits of the batch."""

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from scans import ERROR, PATHS, RATES, STEPS, both_ways, make_arguments, random_grad_output

BOUND = ERROR[torch.float32]
few = settings(max_examples=5, derandomize=True, deadline=None)
per_path = pytest.mark.parametrize("path", PATHS, ids="-".join)
cases = st.fixed_dictionaries(
    {
        "length": st.integers(1, 140),
        "steps": st.sampled_from(STEPS),
        "rates": st.sampled_from(RATES),
        "seed": st.integers(0, 10**6),
    }
)


def assert_same(one: dict, other: dict) -> None:
    """Each may be off by what is allowed."""
    for name, value in one.items():
        allowed = BOUND * (value.norm() + other[name].norm()) + 1e-30
        assert (value - other[name]).norm() <= allowed, name


@per_path
@few
@given(case=cases, a=st.floats(-3, 3), b=st.floats(-3, 3))
def test_linearity_in_x(path, case, a, b):
    x, *others = make_arguments(path[0], **case)
    z = random_grad_output(x)
    y, y_x, y_z = (both_ways(path, (t, *others)).y for t in (a * x + b * z, x, z))
    parts = abs(a) * y_x.norm() + abs(b) * y_z.norm()
    assert (y - a * y_x - b * y_z).norm() <= BOUND * (y.norm() + parts)


@per_path
@few
@given(case=cases, order=st.permutations(range(4)), reverse=st.booleans())
def test_permuting_the_channels(path, case, order, reverse):
    x, dt, A, B, C, D = make_arguments(path[0], channels=4, **case)
    grad_output = random_grad_output(x)
    plain = both_ways(path, (x, dt, A, B, C, D), grad_output, reverse).named()
    permuted = (x[:, :, order], dt[:, :, order], A[order], B, C, D[order])
    result = both_ways(path, permuted, grad_output[:, :, order], reverse).named()
    plain |= {name: plain[name][:, :, order] for name in ("y", "x", "dt")}
    plain |= {name: plain[name][order] for name in ("A", "D")}
    assert_same(result, plain)


@per_path
@few
@given(case=cases)
def test_backwards_is_forwards_on_the_flipped_sequence(path, case):
    x, dt, A, B, C, D = arguments = make_arguments(path[0], **case)
    grad_output = random_grad_output(x)
    backwards = both_ways(path, arguments, grad_output, reverse=True).named()
    flipped = (x.flip(1), dt.flip(1), A, B.flip(1), C.flip(1), D)
    forwards = both_ways(path, flipped, grad_output.flip(1)).named()
    forwards |= {name: forwards[name].flip(1) for name in ("y", "x", "dt", "B", "C")}
    assert_same(backwards, forwards)


@per_path
@few
@given(case=cases, batch=st.integers(2, 3), reverse=st.booleans())
def test_splitting_the_batch(path, case, batch, reverse):
    x, dt, A, B, C, D = arguments = make_arguments(path[0], batch=batch, **case)
    grad_output = random_grad_output(x)
    together = both_ways(path, arguments, grad_output, reverse).named()
    entries = [
        both_ways(path, (x[i], dt[i], A, B[i], C[i], D), grad_output[i], reverse).named()
        for i in torch.arange(batch).split(1)
    ]
    for name, value in together.items():
        parts = [entry[name] for entry in entries]
        apart = sum(parts) if name in ("A", "D") else torch.cat(parts)
        size = sum(part.norm() for part in parts)
        assert (value - apart).norm() <= BOUND * (value.norm() + size) + 1e-30, name
