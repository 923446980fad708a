"""The choice of an operator's backend, and checks of its inputs."""

import os
from collections.abc import Mapping
from contextlib import AbstractContextManager, nullcontext
from functools import partial
from importlib import import_module
from importlib.util import find_spec
from types import ModuleType
from typing import TypeVar

import torch
from torch import Tensor

from asysplat.errors import InputError
from asysplat.kernels.self_check import are_kernels_right


def without_autocast(tensor: Tensor) -> AbstractContextManager:
    """Return a context without autocast on the tensor's device; the meta device has no autocast."""
    if tensor.device.type == "meta":
        return nullcontext()
    return torch.autocast(tensor.device.type, enabled=False)


def to_float64(tensor: Tensor) -> Tensor:
    """Convert a tensor to float64."""
    if tensor.device.type == "mps":
        raise InputError(
            "Apple's GPU (mps) has no float64, which cameras and lengths need: move everything to "
            "the CPU with .to('cpu')."
        )
    return tensor.double()


Implementation = TypeVar("Implementation")
# A forked process lacks the OpenMP threads of its parent, for which torch would wait forever.
os.register_at_fork(after_in_child=partial(torch.set_num_threads, 1))

KERNEL_BACKENDS = ("cpu", "cuda")  # the backends that run kernels; the others are written in torch


def look_up_backend(
    operator: str, backends: Mapping[str, Implementation], backend: str
) -> Implementation:
    """Return the entry of `backends` with the name `backend`."""
    if backend not in backends:
        raise InputError(f"{operator} backend={backend!r}: expected one of {', '.join(backends)}.")
    return backends[backend]


def choose_fastest(x: Tensor, fallback: str, check: str) -> str:
    """Return the name of the fastest backend for the device and dtype of x that is right there.

    The backend `fallback` takes every device and dtype. For `check`, see `are_kernels_right`.
    """
    if x.dtype == torch.float64:
        return fallback
    if x.device.type in ("cpu", "meta"):
        return "cpu"
    if x.device.type != "cuda" or not find_spec("triton"):
        return fallback
    return "cuda" if are_kernels_right(check, x.device) else fallback


def load_kernels(operator: str, backend: str) -> ModuleType:
    """Import an operator's kernels only when they are used: Numba and Triton load slowly."""
    return import_module(f"asysplat.ops.{operator}.{backend}")


def check_kernel_backend(operator: str, backend: str, x: Tensor) -> None:
    """Check that the kernels of `backend` can run on x."""
    if x.dtype == torch.float64:
        raise InputError(
            f"{operator}'s backend {backend!r} computes in float32 and x is float64: choose "
            "'auto', or give float32."
        )
    if x.device.type not in (backend, "meta") and not _uses_interpreter(backend):
        raise InputError(
            f"{operator}'s backend is {backend!r} and x is on {x.device}: choose 'auto', or move "
            f"it with .to('{backend}')."
        )
    if backend == "cuda" and not find_spec("triton"):
        raise InputError(f"{operator}'s backend 'cuda' needs triton: pip install triton.")


def check_shape(operator: str, name: str, tensor: Tensor, shape: object, reason: str = "") -> None:
    """Raise InputError unless a tensor has the expected shape; `reason` continues the message.

    A string, such as "[B, V, H, W]", equals no shape: it is for a wrong number of dimensions.
    """
    if tuple(tensor.shape) != shape:
        raise InputError(
            f"{operator}'s {name} has shape {tuple(tensor.shape)}: expected {shape}{reason}."
        )


def check_device(operator: str, name: str, tensor: Tensor, first: str, like: Tensor) -> None:
    """Raise InputError unless a tensor is on the device of `like`, the argument named `first`."""
    if tensor.device != like.device:
        raise InputError(
            f"{operator}'s {name} is on {tensor.device} and {first} on {like.device}: move both "
            "to one device."
        )


def check_float(operator: str, name: str, tensor: Tensor, advice: str = "") -> None:
    """Raise InputError unless a tensor has floating-point numbers; `advice` ends the message."""
    if not tensor.is_floating_point():
        raise InputError(
            f"{operator}'s {name} is {tensor.dtype}: give floating-point numbers{advice}."
        )


def _uses_interpreter(backend: str) -> bool:
    if backend != "cuda" or not find_spec("triton"):
        return False
    import triton

    return triton.knobs.runtime.interpret
