"""The choice of an operator's backend, and checks of its inputs."""

from collections.abc import Mapping
from importlib import import_module
from importlib.util import find_spec
from types import ModuleType
from typing import TypeVar

import torch
from torch import Tensor

from asysplat.errors import InputError

Form = TypeVar("Form")
FAST = ("cpu", "cuda")  # backends made of kernels


def pick_backend(operator: str, backends: Mapping[str, Form], backend: str) -> Form:
    """Return the function or module of a backend.

    Raises:
        InputError: an unknown name; the message lists the known ones.
    """
    if backend not in backends:
        raise InputError(f"{operator} backend={backend!r}: expected one of {', '.join(backends)}.")
    return backends[backend]


def fast_backend(x: Tensor, in_torch: str) -> str:
    """Return the name of the fastest backend for the device and type of x.

    Args:
        in_torch: the name of the backend for any device and type.
    """
    if x.dtype == torch.float64:
        return in_torch
    if x.device.type in ("cpu", "meta"):
        return "cpu"
    return "cuda" if x.device.type == "cuda" and find_spec("triton") else in_torch


def load_kernels(operator: str, backend: str) -> ModuleType:
    """Import an operator's kernels when they are first used: Numba and Triton load slowly."""
    return import_module(f"asysplat.ops.{operator}.{backend}")


def check_fast_backend(operator: str, backend: str, x: Tensor) -> None:
    """Check that the kernels of `backend` can run on x here.

    Raises:
        InputError: float64, another device, or no Triton.
    """
    if x.dtype == torch.float64:
        raise InputError(
            f"{operator}'s backend {backend!r} computes in float32 and x is float64: choose "
            "'auto', or give float32."
        )
    if x.device.type not in (backend, "meta") and not _interpreted(backend):
        raise InputError(
            f"{operator}'s backend is {backend!r} and x is on {x.device}: choose 'auto', or move "
            f"it with .to('{backend}')."
        )
    if backend == "cuda" and not find_spec("triton"):
        raise InputError(f"{operator}'s backend 'cuda' needs triton: pip install triton.")


def check_shape(operator: str, name: str, tensor: Tensor, shape: object, reason: str = "") -> None:
    """Raise InputError unless a tensor has this shape; `reason` follows in the message."""
    if tuple(tensor.shape) != shape:
        raise InputError(
            f"{operator}'s {name} has shape {tuple(tensor.shape)}: expected {shape}{reason}."
        )


def check_device(operator: str, name: str, tensor: Tensor, first: str, like: Tensor) -> None:
    """Raise InputError unless a tensor is on the device of the argument `first`."""
    if tensor.device != like.device:
        raise InputError(
            f"{operator}'s {name} is on {tensor.device} and {first} on {like.device}: move both "
            "to one device."
        )


def check_float(operator: str, name: str, tensor: Tensor, advice: str = "") -> None:
    """Raise InputError unless a tensor has floating-point numbers."""
    if not tensor.is_floating_point():
        raise InputError(
            f"{operator}'s {name} is {tensor.dtype}: give floating-point numbers{advice}."
        )


def _interpreted(backend: str) -> bool:
    """Return whether Triton interprets its kernels on a CPU, as in tests."""
    if backend != "cuda" or not find_spec("triton"):
        return False
    import triton

    return triton.knobs.runtime.interpret
