"""Scans of zeros, constants and huge numbers, and of padding tokens."""

import pytest
import torch
from scans import (
    ERROR,
    NAMES,
    assert_exact,
    both_ways,
    by_loop,
    make_arguments,
    random_grad_output,
    relative_error,
)

HUGE = 1e18
MAX = torch.finfo(torch.float32).max
PER_TOKEN = ("y", "x", "dt", "B", "C")


def scaled(path, names, factor):
    """Multiply the named arguments, or "y", the gradient of the output."""
    arguments = make_arguments(path[0], 131)
    grad_output = random_grad_output(arguments[0])
    for name, tensor in zip((*NAMES, "y"), (*arguments, grad_output), strict=True):
        if name in names:
            tensor.mul_(factor)
    return arguments, grad_output


@pytest.mark.parametrize("zero", [*NAMES, "y", NAMES])
def test_zeros_are_exact(path, zero):
    assert_exact(path, *scaled(path, zero, 0))


@pytest.mark.parametrize("steps", [1e-8, 0.1, 1e3])
def test_constants_are_exact(path, steps, reverse):
    x, dt, A, B, C, D = (torch.ones_like(a) for a in make_arguments(path[0], 131))
    assert_exact(path, (x, steps * dt, -0.5 * A, B, C, D), torch.ones_like(x), reverse)


@pytest.mark.parametrize("huge", ["x", "D", "y", "xB", "xC", "BC", "xy", "By"])
def test_huge_numbers_are_exact(path, huge):
    """Two factors of 1e18 at once, as much as float32 can hold."""
    arguments, grad_output = scaled(path, huge, HUGE)
    exact = by_loop(path, arguments, grad_output).named()
    assert max(value.abs().max() for value in exact.values()) < MAX / 4
    assert_exact(path, arguments, grad_output)


def test_huge_tokens_before_the_state_is_cleared(path, reverse):
    """They affect neither later tokens nor the gradients of these."""
    x, dt, A, B, C, D = make_arguments(path[0], 131)
    cut = 40  # in the order of the scan
    order = torch.arange(131).flip(0) if reverse else torch.arange(131)
    x[:, order[:cut]] *= HUGE
    B[:, order[:cut]] *= HUGE
    dt[:, order[cut]] = 1e3
    result = both_ways(path, (x, dt, A, B, C, D), reverse=reverse).named()
    exact = by_loop(path, (x, dt, A, B, C, D), reverse=reverse).named()
    for name in PER_TOKEN:
        for part in (order[:cut], order[cut:]):
            error = relative_error(result[name][:, part], exact[name][:, part])
            assert error <= ERROR[torch.float32], name


def with_idle_tokens(tensor: torch.Tensor, places: torch.Tensor, length: int, dt: bool):
    """The tokens at `places` of a longer sequence; the others are random, with dt = 0."""
    longer = torch.randn(tensor.shape[0], length, *tensor.shape[2:])
    if dt:
        longer.zero_()
    longer[:, places] = tensor
    return longer


@pytest.mark.parametrize("where", ["before", "between", "after"])
def test_tokens_of_no_duration_change_nothing(path, where, reverse):
    length = 100
    x, dt, A, B, C, D = arguments = make_arguments(path[0], length)
    places = {
        "before": torch.arange(length) + 77,
        "between": torch.randperm(177)[:length].sort().values,
        "after": torch.arange(length),
    }[where]
    x, dt, B, C = (with_idle_tokens(t, places, 177, t is dt) for t in (x, dt, B, C))
    grad_output = torch.zeros_like(x)
    grad_output[:, places] = random_grad_output(arguments[0])
    padded = both_ways(path, (x, dt, A, B, C, D), grad_output, reverse).named()
    results = {name: t[:, places] if name in PER_TOKEN else t for name, t in padded.items()}
    exact = by_loop(path, arguments, reverse=reverse).named()
    for name, value in results.items():
        assert relative_error(value, exact[name]) <= ERROR[torch.float32], name


@pytest.mark.parametrize("length", [100, 128])
def test_padding_at_the_end_gives_the_same_bits(path, length):
    x, dt, A, B, C, D = arguments = make_arguments(path[0], length)
    places = torch.arange(length)
    x, dt, B, C = (with_idle_tokens(t, places, 177, t is dt) for t in (x, dt, B, C))
    padded = both_ways(path, (x, dt, A, B, C, D))
    assert torch.equal(padded.y[:, :length], both_ways(path, arguments).y)
