"""Selective scan of Mamba (Gu and Dao 2023, Eq. 2), as MambaVision uses it within a frame."""

from jaxtyping import Float
from torch import Tensor

from asysplat.ops.dispatch import pick_backend, run_scan
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
    form = pick_backend("selective_scan", _BACKENDS, backend)
    return run_scan(form, x, dt, A, B, C, D, reverse)
