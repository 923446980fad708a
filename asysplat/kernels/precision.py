"""Types of computations: float64 where there is none, and no half precision by autocast."""

from contextlib import AbstractContextManager, nullcontext

import torch
from torch import Tensor

from asysplat.errors import InputError


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
