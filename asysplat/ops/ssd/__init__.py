"""State-space duality of Mamba2 (Dao and Gu 2024, Eq. 1 with scalar A per head)."""

import torch
from jaxtyping import Float
from torch import Tensor

from asysplat.errors import InputError
from asysplat.ops.precision import without_autocast
from asysplat.ops.ssd.chunked import ssd_chunked
from asysplat.ops.ssd.reference import ssd_reference

_BACKENDS = {"auto": ssd_chunked, "chunked": ssd_chunked, "reference": ssd_reference}


def ssd(
    x: Float[Tensor, "B L H P"],
    dt: Float[Tensor, "B L H"],
    A: Float[Tensor, "H"],
    B: Float[Tensor, "B L N"],
    C: Float[Tensor, "B L N"],
    D: Float[Tensor, "H"],
    backend: str = "auto",
    reverse: bool = False,
) -> Float[Tensor, "B L H P"]:
    """h_t = exp(dt_t A) h_{t-1} + dt_t B_t x_t^T and y_t = C_t h_t + D x_t, per head.

    Args:
        x: inputs, H heads of width P; half precision is computed in fp32, returned as it came.
        dt: step sizes > 0, after the softplus.
        A: < 0, so that no exponent is positive.
        B, C: input and output vectors, shared by the heads.
        D: skip weight of each head.
        reverse: scan from the last token to the first.

    Raises:
        InputError: an unknown backend.
    """
    if backend not in _BACKENDS:
        raise InputError(f"ssd backend={backend!r}: expected one of {list(_BACKENDS)}.")
    dtype = torch.promote_types(x.dtype, torch.float32)
    arguments = [tensor.to(dtype) for tensor in (x, dt, A, B, C, D)]
    if reverse:
        arguments = [t.flip(1) if t.ndim >= 3 else t for t in arguments]
    with without_autocast(x):
        y = _BACKENDS[backend](*arguments)
    return (y.flip(1) if reverse else y).to(x.dtype)
