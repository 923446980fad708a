"""Bad inputs of a scan: one error that names the argument, its value and the expected one."""

import inspect

import pytest
import torch
from scans import NAMES, SCANS, make_arguments

from asysplat.errors import InputError

per_scan = pytest.mark.parametrize("scan", SCANS)
CHANGES = {
    "dimensions": (lambda t: t[0], r"has shape \(.*\): expected [([]"),
    "type": (torch.Tensor.long, "is torch.int64: give floating-point numbers"),
    "device": (lambda t: t.to("meta"), r"is on \w+ and x on \w+: move both to one device"),
}


def assert_refused(scan, arguments, message, backend="auto"):
    with pytest.raises(InputError, match=rf"{scan}'s {message}"):
        # Without the tests' type checker, which would raise first.
        inspect.unwrap(SCANS[scan])(*arguments, backend=backend)


def with_argument(scan, name, change):
    arguments = list(make_arguments(scan, 7))
    arguments[NAMES.index(name)] = change(arguments[NAMES.index(name)])
    return arguments


@per_scan
@pytest.mark.parametrize("name", NAMES[1:])
def test_sizes_that_do_not_fit(scan, name):
    for dimension in (0, 1, -1):

        def longer(tensor, dimension=dimension):
            return torch.cat((tensor, tensor), min(dimension, tensor.ndim - 1))

        # If two tensors disagree on the size of a state, the error may name either.
        blamed = r"\w+" if name in "ABC" and dimension else name
        arguments = with_argument(scan, name, longer)
        assert_refused(scan, arguments, rf"{blamed} has shape \(.*\): expected [([]")


@per_scan
@pytest.mark.parametrize("kind", CHANGES)
def test_one_argument_of_another_kind(scan, kind):
    change, message = CHANGES[kind]
    for name in NAMES:
        # If x is on another device, the error names the next argument.
        blamed = r"\w+" if name == "x" and kind == "device" else name
        assert_refused(scan, with_argument(scan, name, change), f"{blamed} {message}")


@per_scan
def test_no_tokens_and_backends_that_cannot_run(scan):
    x, dt, A, B, C, D = arguments = make_arguments(scan, 7)
    empty = (x[:, :0], dt[:, :0], A, B[:, :0], C[:, :0], D)
    assert_refused(scan, empty, "x has shape .*: every side must be at least 1")
    double = [argument.double() for argument in arguments]
    for backend in ("cpu", "cuda"):
        assert_refused(scan, double, rf"backend '{backend}' .* x is float64", backend)
    with pytest.raises(InputError, match="backend='fast'"):
        SCANS[scan](*arguments, backend="fast")
    expected = SCANS[scan](*double, backend="reference")
    torch.testing.assert_close(SCANS[scan](*double), expected)
