"""State-space duality of Mamba2 (Dao and Gu 2024, Eq. 1 with scalar A per head)."""

from jaxtyping import Float
from torch import Tensor

from asysplat.ops.dispatch import run_scan
from asysplat.ops.scan_operator import scan_operator
from asysplat.ops.ssd.chunked import CHUNK, ssd_chunked
from asysplat.ops.ssd.reference import ssd_reference


def count_flops(x_shape: tuple[int, ...], B_shape: tuple[int, ...]) -> tuple[int, int]:
    """Of the products of the chunked form, forward and backward."""
    tokens, heads, head_width = x_shape[0] * x_shape[1], x_shape[2], x_shape[3]
    state = heads * head_width * B_shape[-1]
    scores = 2 * tokens * CHUNK * B_shape[-1]
    within = 2 * tokens * CHUNK * heads * head_width
    forward = scores + within + 4 * tokens * state
    # Scores and states again; then every product has two gradients, and the decays need what was
    # read of the state.
    return forward, 3 * scores + 2 * within + 12 * tokens * state


_FORMS = {"chunked": ssd_chunked, "reference": ssd_reference}
_OPERATOR = scan_operator("ssd", count_flops)


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
        backend: "cpu" or "cuda", "chunked" (torch, any device and float type), "reference", or
            "auto", which is the fast one for the device, and "chunked" for float64.
        reverse: scan from the last token to the first.

    Raises:
        InputError: an unknown backend, or one that cannot take these tensors; shapes or devices
            that do not go together; integers; no token.
    """
    return run_scan("ssd", _FORMS, _OPERATOR, backend, (x, dt, A, B, C, D), reverse)
