"""Both scans: every backend against a loop in float64, and as operators of torch."""

import inspect
from itertools import product

import pytest
import torch
from scans import (
    ERROR,
    EXACT_PATHS,
    NAMES,
    RATES,
    SCANS,
    STEPS,
    Result,
    assert_exact,
    both_ways,
    by_loop,
    errors,
    make_arguments,
    random_grad_output,
    relative_error,
    sum_error,
)
from torch.utils.flop_counter import FlopCounterMode

from asysplat.errors import InputError

CHUNKS = (32, 64, 128, 256)  # those of all back ends
LENGTHS = sorted({n for c in CHUNKS for n in (c, c + 1)} | {1, 17, 31, 63, 131, 515})
HALF = [("1e-8", "1e4"), ("spread", "spread"), ("mixed", "1")]
SIZES = [(1, 1, 1, 1), (3, 1, 5, 7), (1, 9, 1, 1), (3, 2, 33, 19)]
CASES = [{"length": length} for length in LENGTHS]
CASES += [{"length": 131, "steps": steps, "rates": rates} for steps, rates in product(STEPS, RATES)]
CASES += [
    {"length": 131, "steps": steps, "rates": rates, "dtype": torch.bfloat16}
    for steps, rates in HALF
]
CASES += [{"length": 131, "dtype": torch.float16}]
CASES += [
    {"length": 67} | dict(zip(("batch", "channels", "head_dim", "state"), sizes, strict=True))
    for sizes in SIZES
]
HUGE = 1e18
PER_TOKEN = ("y", "x", "dt", "B", "C")
# A sum of 10,000 tokens or more, in a state or in the gradients of A and D, is rounded at each
# addition, and a float32 decay near 1 has few digits of its distance to 1: no form is within 2e-6.
SLACK = 3

per_scan = pytest.mark.parametrize("name", SCANS)
per_exact_path = pytest.mark.parametrize("path", EXACT_PATHS, ids="-".join)


def run(path, arguments, reverse=False):
    return SCANS[path[0]](*arguments, backend=path[1], reverse=reverse)


def assert_same_bits(one, other):
    for name, value in one.named().items():
        assert torch.equal(value, other.named()[name]), name


@per_exact_path
def test_float64_forms_equal_the_loop(path, reverse):
    for steps in ("1", "spread"):
        arguments = [a.double() for a in make_arguments(path[0], 131, steps, "spread")]
        exact = by_loop(path, arguments, reverse=reverse)
        found = errors(both_ways(path, arguments, reverse=reverse), exact)
        assert max(found.values()) < 1e-12, (steps, found)


@per_exact_path
def test_every_gradient_equals_finite_differences(path, reverse):
    """Over the end of a chunk, with steps that clear the state."""
    arguments = make_arguments(path[0], 66, "3", batch=1, channels=2, head_dim=2, state=2)
    leaves = [argument.double().requires_grad_() for argument in arguments]
    assert torch.autograd.gradcheck(
        lambda *leaves: run(path, leaves, reverse), leaves, fast_mode=True
    )


@pytest.mark.parametrize("case", CASES, ids=str)
def test_every_size_step_rate_and_type_is_exact(path, case, reverse):
    # A gradient of A that is one number may be a sum in which nearly all cancels.
    slack = 2 if "batch" in case else 0
    assert_exact(path, make_arguments(path[0], **case), reverse=reverse, slack=slack)


@pytest.mark.medium
@pytest.mark.parametrize(
    "length, steps, rates, slack",
    [
        (65_280, "mixed", "1", 0),  # as many tokens as 32 images at 540x960
        (65_280, "1e-8", "1e-4", SLACK),
        pytest.param(2**18, "1e-2", "1", 0, marks=pytest.mark.slow),
        pytest.param(2**20, "1e-2", "1", SLACK, marks=pytest.mark.slow),
        pytest.param(2**20, "mixed", "1", SLACK, marks=pytest.mark.slow),
    ],
)
def test_long_sequences_are_exact(path, length, steps, rates, slack, reverse):
    sizes = {"batch": 1, "channels": 2, "head_dim": 1, "state": 2}
    assert_exact(
        path, make_arguments(path[0], length, steps, rates, **sizes), reverse=reverse, slack=slack
    )


@pytest.mark.parametrize(
    "length, step, rate, slack",
    [*[(131, step, 0.5, 0) for step in (1e-8, 0.1, 1e3)], (65_280, 1, 1e-4, SLACK)],
)
def test_constants_are_exact(path, length, step, rate, slack, reverse):
    sizes = {"batch": 1, "channels": 2, "head_dim": 1, "state": 2} if length > 131 else {}
    x, dt, A, B, C, D = (torch.ones_like(a) for a in make_arguments(path[0], length, **sizes))
    arguments = (x, step * dt, -rate * A, B, C, D)
    assert_exact(path, arguments, torch.ones_like(x), reverse, slack)


@pytest.mark.parametrize(
    "names, factor",
    [
        *[(name, 0) for name in (*NAMES, "y", NAMES)],
        # Two factors of 1e18 at once, as much as float32 can hold.
        *[(names, HUGE) for names in ("x", "D", "y", "xB", "xC", "BC", "xy", "By")],
    ],
)
def test_zeros_and_huge_numbers_are_exact(path, names, factor):
    """Of the arguments, and of y, the gradient of the output."""
    arguments = make_arguments(path[0], 131)
    grad_output = random_grad_output(arguments[0])
    for name, tensor in zip((*NAMES, "y"), (*arguments, grad_output), strict=True):
        if name in names:
            tensor.mul_(factor)
    exact = by_loop(path, arguments, grad_output).named()
    most = torch.finfo(torch.float32).max / 4
    assert max(value.abs().max() for value in exact.values()) < most
    assert_exact(path, arguments, grad_output)


def test_huge_tokens_before_the_state_is_cleared_change_nothing_after(path, reverse):
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


@pytest.mark.parametrize("where", ["before", "between", "after"])
@pytest.mark.parametrize("length", [100, 128])
def test_tokens_of_no_duration_change_nothing(path, length, where, reverse):
    x, dt, A, B, C, D = arguments = make_arguments(path[0], length)
    places = torch.arange(length)
    if where != "after":
        places = places + 77 if where == "before" else torch.randperm(177)[:length].sort().values

    def padded(tensor):
        longer = torch.randn(tensor.shape[0], length + 77, *tensor.shape[2:])
        longer[:, places] = tensor
        return longer

    idle = torch.zeros_like(padded(dt))
    idle[:, places] = dt
    grad_output = torch.zeros_like(padded(x))
    grad_output[:, places] = random_grad_output(x)
    result = both_ways(path, (padded(x), idle, A, padded(B), padded(C), D), grad_output, reverse)
    if where == "after" and not reverse:
        assert torch.equal(result.y[:, places], both_ways(path, arguments).y)
    exact = by_loop(path, arguments, reverse=reverse).named()
    for name, value in result.named().items():
        own = value[:, places] if name in PER_TOKEN else value
        assert relative_error(own, exact[name]) <= ERROR[torch.float32], name


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
    grads = torch.autograd.grad(y, leaves, back(spread_out(random_grad_output(y))))
    found = errors(Result(y.detach(), tuple(map(back, grads))), exact)
    assert max(found.values()) <= ERROR[torch.float32], found


def test_expanded_inputs_and_gradient(path, reverse):
    """One token, one batch entry and one rate for all, and one gradient for all of y."""
    x, dt, A, B, C, D = arguments = make_arguments(path[0], 67)
    leaves = [x[:, :1], dt[..., :1], A[:1], B[:1], C[:, :, :1], D[:1]]
    leaves = [leaf.clone().requires_grad_() for leaf in leaves]
    expanded = [leaf.expand_as(full) for leaf, full in zip(leaves, arguments, strict=True)]
    y = run(path, expanded, reverse)
    exact = by_loop(path, expanded, torch.ones_like(y), reverse)
    assert relative_error(y, exact.y) <= ERROR[torch.float32]
    grads = torch.autograd.grad(y.sum(), leaves)
    for name, grad, whole in zip(NAMES, grads, exact.grads, strict=True):
        assert sum_error(grad, whole) <= ERROR[torch.float32], name


@pytest.mark.parametrize("dtype", [torch.float32, torch.bfloat16, torch.float16], ids=str)
def test_each_input_alone_or_none_needs_a_gradient_and_does_not_change(path, dtype):
    arguments = make_arguments(path[0], 67, dtype=dtype)
    all_of_them = both_ways(path, arguments, torch.ones_like(arguments[0])).named()
    y = run(path, arguments)
    assert y.dtype == dtype and not y.requires_grad
    for index, name in enumerate(NAMES):
        leaf = arguments[index].clone().requires_grad_()
        run(path, [*arguments[:index], leaf, *arguments[index + 1 :]]).sum().backward()
        assert leaf.grad.dtype == leaf.dtype and torch.equal(leaf, arguments[index]), name
        assert torch.equal(leaf.grad, all_of_them[name]), name


def test_autocast_changes_nothing(path):
    """Nor around the kernels' backward pass."""
    leaves = [argument.requires_grad_() for argument in make_arguments(path[0], 67)]
    plain = both_ways(path, leaves)
    for around_backward in (False, path[1] == "cpu"):
        with torch.autocast("cpu", dtype=torch.bfloat16):
            y = run(path, leaves)
        with torch.autocast("cpu", dtype=torch.bfloat16, enabled=around_backward):
            grads = torch.autograd.grad(y, leaves, random_grad_output(y))
        assert_same_bits(Result(y, grads), plain)


@pytest.mark.parametrize("dtype", [torch.float32, torch.bfloat16], ids=str)
def test_any_number_of_threads_and_any_memory_give_the_same_bits(path, threads, dtype, reverse):
    for length in (1, 131):
        sizes = {"channels": 4, "head_dim": 16, "state": 16, "dtype": dtype}
        arguments = make_arguments(path[0], length, **sizes)
        threads(1)
        one = both_ways(path, arguments, reverse=reverse)
        for count in (1, 2):
            threads(count)
            assert_same_bits(both_ways(path, arguments, reverse=reverse), one)
        torch.use_deterministic_algorithms(True)  # fills torch.empty with NaN
        try:
            assert_same_bits(both_ways(path, arguments, reverse=reverse), one)
        finally:
            torch.use_deterministic_algorithms(False)


@per_scan
def test_each_scan_is_one_operator_of_torch(name):
    """opcheck (schema, autograd, meta device, AOT dispatch), and torch.compile in one graph."""
    arguments = [a.requires_grad_() for a in make_arguments(name, 70)]
    plain = [a.detach() for a in arguments]
    operator = getattr(torch.ops.asysplat, name).default
    torch.library.opcheck(operator, ("cpu", *arguments, True, True))
    torch.library.opcheck(operator, ("cpu", *plain, True, False))

    # The operator itself: the shape checks that wrap the public function in tests do not compile.
    @torch.compile(backend="aot_eager", fullgraph=True)
    def compiled(*arguments):
        return operator("cpu", *arguments, False, True)[0]

    expected, got = SCANS[name](*arguments), compiled(*arguments)
    assert torch.equal(got, expected)
    grads = [torch.autograd.grad(y.square().sum(), arguments) for y in (expected, got)]
    assert all(map(torch.equal, *grads))
    saved_state = operator("cpu", *plain, False, True)[1]
    without, nothing = operator("cpu", *plain, False, False)
    assert torch.equal(without, expected) and saved_state.numel() > 0 and nothing.numel() == 0


@per_scan
def test_flops_are_counted_on_the_meta_device(name):
    arguments = [a.to("meta").requires_grad_() for a in make_arguments(name, 128)]
    with FlopCounterMode(display=False) as counter:
        y = SCANS[name](*arguments)
        forward = counter.get_total_flops()
        y.sum().backward()
    # At least one product for each element of the states.
    assert forward > 2 * arguments[0].numel() * 5
    assert counter.get_total_flops() > 3 * forward


def assert_refused(scan, arguments, message, backend="auto"):
    with pytest.raises(InputError, match=rf"{scan}'s {message}"):
        # Without the tests' type checker, which would raise first.
        inspect.unwrap(SCANS[scan])(*arguments, backend=backend)


CHANGES = {
    "dimensions": (lambda t: t[0], r"has shape \(.*\): expected [([]"),
    "type": (torch.Tensor.long, "is torch.int64: give floating-point numbers"),
    "device": (lambda t: t.to("meta"), r"is on \w+ and x on \w+: move both to one device"),
}
for dimension in (0, 1, -1):
    CHANGES[f"size {dimension}"] = (
        lambda t, d=dimension: torch.cat((t, t), min(d, t.ndim - 1)),
        CHANGES["dimensions"][1],
    )


@per_scan
@pytest.mark.parametrize("kind", CHANGES)
def test_an_argument_that_does_not_fit_is_named(name, kind):
    change, message = CHANGES[kind]
    sizes = kind.startswith("size")
    for index, argument in enumerate(NAMES):
        if sizes and argument == "x":
            continue
        # x on another device, or two tensors that disagree: the error may name either.
        either = argument == "x" and kind == "device"
        either |= sizes and argument in "ABC" and kind != "size 0"
        arguments = list(make_arguments(name, 7))
        arguments[index] = change(arguments[index])
        blamed = r"\w+" if either else argument
        assert_refused(name, arguments, f"{blamed} {message}")


@per_scan
def test_no_tokens_and_backends_that_cannot_run(name):
    x, dt, A, B, C, D = arguments = make_arguments(name, 7)
    empty = (x[:, :0], dt[:, :0], A, B[:, :0], C[:, :0], D)
    assert_refused(name, empty, "x has shape .*: every side must be at least 1")
    double = [argument.double() for argument in arguments]
    for backend in ("cpu", "cuda"):
        assert_refused(name, double, rf"backend '{backend}' .* x is float64", backend)
    with pytest.raises(InputError, match="backend='fast'"):
        SCANS[name](*arguments, backend="fast")
    expected = SCANS[name](*double, backend="reference")
    torch.testing.assert_close(SCANS[name](*double), expected)
