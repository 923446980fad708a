"""What the operators have in common: picking a back end, and how a scan is entered and left."""

from collections.abc import Callable, Mapping
from typing import TypeVar

import torch
from torch import Tensor

from asysplat.errors import InputError
from asysplat.ops.precision import without_autocast

Form = TypeVar("Form")


def pick_backend(operator: str, backends: Mapping[str, Form], backend: str) -> Form:
    """What `backend` names, a function or a module, or InputError with the names there are."""
    if backend not in backends:
        raise InputError(f"{operator} backend={backend!r}: expected one of {', '.join(backends)}.")
    return backends[backend]


def run_scan(
    form: Callable[..., Tensor],
    x: Tensor,
    dt: Tensor,
    A: Tensor,
    B: Tensor,
    C: Tensor,
    D: Tensor,
    reverse: bool,
) -> Tensor:
    """Run one form of a scan over dimension 1, in fp32 at least, backwards if asked."""
    dtype = torch.promote_types(x.dtype, torch.float32)

    def sequence(tensor: Tensor) -> Tensor:
        return (tensor.flip(1) if reverse else tensor).to(dtype)

    with without_autocast(x):
        y = form(sequence(x), sequence(dt), A.to(dtype), sequence(B), sequence(C), D.to(dtype))
    return (y.flip(1) if reverse else y).to(x.dtype)
