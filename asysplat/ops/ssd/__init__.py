"""State-space duality of Mamba2 (Dao and Gu 2024, Eq. 1 with scalar A per head)."""

from jaxtyping import Float
from torch import Tensor

from asysplat.ops.dispatch import pick_backend, run_scan
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
    form = pick_backend("ssd", _BACKENDS, backend)
    return run_scan(form, x, dt, A, B, C, D, reverse)
