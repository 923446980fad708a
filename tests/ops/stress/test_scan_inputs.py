"""Strided and expanded inputs, other types, inputs without gradients, and the same bits in every
run, on any number of threads and in any memory."""

import pytest
import torch
from scans import (
    ERROR,
    NAMES,
    SCANS,
    Result,
    both_ways,
    by_loop,
    make_arguments,
    random_grad_output,
    relative_error,
    sum_error,
)


def run(path, arguments, reverse=False):
    return SCANS[path[0]](*arguments, backend=path[1], reverse=reverse)


def test_strided_inputs_and_gradient(path, reverse):
    arguments = make_arguments(path[0], 67)
    exact = by_loop(path, arguments, reverse=reverse)

    def spread_out(tensor):
        """Reverse the dimensions in memory and interleave a copy."""
        return torch.stack((tensor.permute(*range(tensor.ndim)[::-1]),) * 2, -1)

    def back(tensor):
        return tensor[..., 0].permute(*range(tensor.ndim - 1)[::-1])

    leaves = [spread_out(argument).requires_grad_() for argument in arguments]
    y = run(path, [back(leaf) for leaf in leaves], reverse)
    assert relative_error(y, exact.y) <= ERROR[torch.float32]
    grads = torch.autograd.grad(y, leaves, back(spread_out(random_grad_output(y))))
    for name, grad, right in zip(NAMES, grads, exact.grads, strict=True):
        assert relative_error(back(grad), right) <= ERROR[torch.float32], name


def test_expanded_inputs_and_gradient(path, reverse):
    """One token, one batch entry and one rate for all, and one gradient for all of y."""
    x, dt, A, B, C, D = make_arguments(path[0], 67)
    leaves = [x[:, :1], dt[..., :1], A[:1], B[:1], C[:, :, :1], D[:1]]
    leaves = [leaf.clone().requires_grad_() for leaf in leaves]
    shapes = [argument.shape for argument in (x, dt, A, B, C, D)]
    expanded = [leaf.expand(shape) for leaf, shape in zip(leaves, shapes, strict=True)]
    y = run(path, expanded, reverse)
    exact = by_loop(path, expanded, torch.ones_like(y), reverse)
    assert relative_error(y, exact.y) <= ERROR[torch.float32]
    grads = torch.autograd.grad(y.sum(), leaves)
    for name, grad, whole in zip(NAMES, grads, exact.grads, strict=True):
        assert sum_error(grad, whole) <= ERROR[torch.float32], name


def test_each_input_alone_or_none_needs_a_gradient(path):
    arguments = make_arguments(path[0], 67)
    all_of_them = both_ways(path, arguments, torch.ones_like(arguments[0])).named()
    assert not run(path, arguments).requires_grad
    for index, name in enumerate(NAMES):
        leaf = arguments[index].clone().requires_grad_()
        run(path, [*arguments[:index], leaf, *arguments[index + 1 :]]).sum().backward()
        assert torch.equal(leaf.grad, all_of_them[name]), name


@pytest.mark.parametrize("dtype", [torch.float32, torch.bfloat16, torch.float16], ids=str)
def test_results_have_the_types_of_the_inputs_which_do_not_change(path, dtype):
    arguments = make_arguments(path[0], 67, dtype=dtype)
    leaves = [argument.clone().requires_grad_() for argument in arguments]
    y = run(path, leaves)
    grads = torch.autograd.grad(y.sum(), leaves)
    assert y.dtype == dtype
    for name, leaf, grad, argument in zip(NAMES, leaves, grads, arguments, strict=True):
        assert grad.dtype == argument.dtype, name
        assert torch.equal(leaf, argument), name


def test_autocast_changes_nothing(path):
    leaves = [argument.requires_grad_() for argument in make_arguments(path[0], 67)]
    plain = both_ways(path, leaves)
    with torch.autocast("cpu", dtype=torch.bfloat16):
        y = run(path, leaves)
    grads = torch.autograd.grad(y, leaves, random_grad_output(y))
    assert_same_bits(Result(y, grads), plain)


@pytest.mark.parametrize("name", SCANS)
def test_kernels_backward_pass_under_autocast_has_the_same_bits(name):
    path, leaves = (name, "cpu"), [a.requires_grad_() for a in make_arguments(name, 67)]
    with torch.autocast("cpu", dtype=torch.bfloat16):
        y = run(path, leaves)
        grads = torch.autograd.grad(y, leaves, random_grad_output(y))
    assert_same_bits(Result(y, grads), both_ways(path, leaves))


def assert_same_bits(one: Result, other: Result) -> None:
    for name, value in one.named().items():
        assert torch.equal(value, other.named()[name]), name


@pytest.mark.parametrize("dtype", [torch.float32, torch.bfloat16], ids=str)
def test_any_number_of_threads_gives_the_same_bits(path, threads, dtype, reverse):
    arguments = make_arguments(path[0], 131, channels=4, head_dim=16, state=16, dtype=dtype)

    def run(count):
        threads(count)
        return both_ways(path, arguments, reverse=reverse)

    one = run(1)
    for count in (1, 2):
        assert_same_bits(run(count), one)


@pytest.mark.parametrize("length", [1, 67])
def test_every_element_is_written(path, length, reverse):
    arguments = make_arguments(path[0], length)
    clean = both_ways(path, arguments, reverse=reverse)
    torch.use_deterministic_algorithms(True)  # fills torch.empty with NaN
    try:
        assert_same_bits(both_ways(path, arguments, reverse=reverse), clean)
    finally:
        torch.use_deterministic_algorithms(False)
