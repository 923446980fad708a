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


@pytest.mark.parametrize("name", NAMES)
def test_number_of_dimensions(path, name):
    arguments = with_argument(path, name, lambda t: t[0])
    with pytest.raises(InputError, match=rf"{path[0]}'s {name} has shape \(.*\): expected [([]"):
        run(path, arguments)


def test_no_tokens(path):
    x, dt, A, B, C, D = make_arguments(path[0], 7)
    with pytest.raises(
        InputError, match=rf"{path[0]}'s x has shape .*: every side must be at least 1"
    ):
        run(path, (x[:, :0], dt[:, :0], A, B[:, :0], C[:, :0], D))


@pytest.mark.parametrize("name", NAMES)
def test_whole_numbers(path, name):
    arguments = with_argument(path, name, torch.Tensor.long)
    message = rf"{path[0]}'s {name} is torch.int64: give floating-point numbers"
    with pytest.raises(InputError, match=message):
        run(path, arguments)


@pytest.mark.parametrize("name", NAMES[1:])
def test_devices_that_differ(path, name):
    arguments = with_argument(path, name, lambda t: t.to("meta"))
    with pytest.raises(InputError, match=rf"{path[0]}'s {name} is on meta and x on cpu"):
        run(path, arguments)


@pytest.mark.parametrize("backend", ["cpu", "cuda"])
@pytest.mark.parametrize("name", SCANS)
def test_kernels_refuse_float64(name, backend):
    arguments = [argument.double() for argument in make_arguments(name, 7)]
    with pytest.raises(InputError, match=rf"{name}'s backend '{backend}' .* x is float64"):
        run((name, backend), arguments)


@pytest.mark.parametrize("name", SCANS)
def test_auto_takes_float64(name):
    arguments = [argument.double() for argument in make_arguments(name, 7)]
    expected = SCANS[name](*arguments, backend="reference")
    torch.testing.assert_close(SCANS[name](*arguments), expected)
