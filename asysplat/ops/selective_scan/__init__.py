"""Selective scan of Mamba (Gu and Dao 2023, Eq. 2), as MambaVision uses it within a frame."""

import torch
from jaxtyping import Float
from torch import Tensor

from asysplat.errors import InputError
from asysplat.ops.precision import without_autocast
from asysplat.ops.selective_scan.recurrent import selective_scan_recurrent
from asysplat.ops.selective_scan.reference import selective_scan_reference

_BACKENDS = {
    "auto": selective_scan_recurrent,
    "recurrent": selective_scan_recurrent,
    "reference": selective_scan_reference,
}


def selective_scan(
    x: Float[Tensor, "B L D"],
    dt: Float[Tensor, "B L D"],
    A: Float[Tensor, "D N"],
    B: Float[Tensor, "B L N"],
    C: Float[Tensor, "B L N"],
    D: Float[Tensor, "D"],
    backend: str = "auto",
    reverse: bool = False,
) -> Float[Tensor, "B L D"]:
    """h_t = exp(dt_t A) h_{t-1} + dt_t B_t x_t and y_t = C_t . h_t + D x_t, per channel.

    Args:
        x: inputs; half precision is computed in fp32 and returned as it came.
        dt: step sizes > 0, after the softplus.
        A: < 0, so that no exponent is positive.
        B, C: input and output vectors, shared by the channels.
        D: skip weight of each channel.
        reverse: scan from the last token to the first.

    Raises:
        InputError: an unknown backend.
    """
    if backend not in _BACKENDS:
        raise InputError(f"selective_scan backend={backend!r}: expected one of {list(_BACKENDS)}.")
    dtype = torch.promote_types(x.dtype, torch.float32)
    arguments = [tensor.to(dtype) for tensor in (x, dt, A, B, C, D)]
    if reverse:
        arguments = [t.flip(1) if t.ndim == 3 else t for t in arguments]
    with without_autocast(x):
        y = _BACKENDS[backend](*arguments)
    return (y.flip(1) if reverse else y).to(x.dtype)
