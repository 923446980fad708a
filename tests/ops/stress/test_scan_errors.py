"""Bad inputs of a scan: one error that names the argument, its value and the expected one."""

import inspect

import pytest
import torch
from scans import NAMES, SCANS, make_arguments

from asysplat.errors import InputError


def run(path, arguments):
    """Call it without the tests' type checker, which would raise first."""
    return inspect.unwrap(SCANS[path[0]])(*arguments, backend=path[1])


def with_argument(path, name, change):
    arguments = list(make_arguments(path[0], 7))
    arguments[NAMES.index(name)] = change(arguments[NAMES.index(name)])
    return arguments


@pytest.mark.parametrize("dimension", [0, 1, -1])
@pytest.mark.parametrize("name", NAMES[1:])
def test_sizes_that_do_not_fit(path, name, dimension):
    def longer(tensor):
        return torch.cat((tensor, tensor), min(dimension, tensor.ndim - 1))

    # If two tensors disagree on the size of a state, the error may name either.
    blamed = r"\w+" if name in "ABC" and dimension else name
    with pytest.raises(InputError, match=rf"{path[0]}'s {blamed} has shape \(.*\): expected [([]"):
        run(path, with_argument(path, name, longer))


def test_no_tokens(path):
    x, dt, A, B, C, D = make_arguments(path[0], 7)
    with pytest.raises(
        InputError, match=rf"{path[0]}'s x has shape .*: every side must be at least 1"
    ):
        run(path, (x[:, :0], dt[:, :0], A, B[:, :0], C[:, :0], D))


@pytest.mark.parametrize(
    "change, message",
    [
        (lambda t: t[0], r"has shape \(.*\): expected [([]"),
        (torch.Tensor.long, "is torch.int64: give floating-point numbers"),
        (lambda t: t.to("meta"), r"is on \w+ and x on \w+: move both to one device"),
    ],
    ids=["dimensions", "type", "device"],
)
@pytest.mark.parametrize("name", NAMES)
def test_one_argument_of_another_kind(path, name, change, message):
    # If x is on another device, the error names the next argument.
    blamed = r"\w+" if name == "x" and "is on" in message else name
    with pytest.raises(InputError, match=rf"{path[0]}'s {blamed} {message}"):
        run(path, with_argument(path, name, change))


@pytest.mark.parametrize("name", SCANS)
def test_kernels_refuse_float64_and_auto_takes_it(name):
    arguments = [argument.double() for argument in make_arguments(name, 7)]
    for backend in ("cpu", "cuda"):
        with pytest.raises(InputError, match=rf"{name}'s backend '{backend}' .* x is float64"):
            run((name, backend), arguments)
    expected = SCANS[name](*arguments, backend="reference")
    torch.testing.assert_close(SCANS[name](*arguments), expected)
