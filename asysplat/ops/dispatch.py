"""Which back end of an operator runs: the one that is asked for, or the fast one for a device."""

from collections.abc import Mapping
from importlib.util import find_spec
from typing import TypeVar

import torch
from torch import Tensor

from asysplat.errors import InputError

Form = TypeVar("Form")
FAST = ("cpu", "cuda")  # back ends made of kernels


def pick_backend(operator: str, backends: Mapping[str, Form], backend: str) -> Form:
    """Return the function or module that `backend` names.

    Raises:
        InputError: an unknown name; the message lists those there are.
    """
    if backend not in backends:
        raise InputError(f"{operator} backend={backend!r}: expected one of {', '.join(backends)}.")
    return backends[backend]


def fast_backend(x: Tensor, in_torch: str) -> str:
    """Return the name of the fastest back end for the device and the type of x.

    Args:
        x: what is computed with.
        in_torch: the name of the one for any device and type.
    """
    if x.dtype == torch.float64:
        return in_torch
    if x.device.type in ("cpu", "meta"):
        return "cpu"
    if x.device.type == "cuda" and find_spec("triton"):
        return "cuda"
    return in_torch


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


def _interpreted(backend: str) -> bool:
    """Return whether Triton interprets its kernels on a CPU, as tests let it."""
    if backend != "cuda" or not find_spec("triton"):
        return False
    import triton

    return triton.knobs.runtime.interpret
