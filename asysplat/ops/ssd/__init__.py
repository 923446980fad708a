"""State-space duality of Mamba2 (Dao and Gu 2024, Eq. 1 with scalar A per head)."""

from jaxtyping import Float
from torch import Tensor

from asysplat.ops.scan import Scan, ScanInputs
from asysplat.ops.ssd.reference import CHUNK, ssd_chunked, ssd_reference


def count_flops(x_shape: tuple[int, ...], B_shape: tuple[int, ...]) -> tuple[int, int]:
    """Count the products of the chunked form, forward and backward."""
    batch, length, heads, head_dim = x_shape
    tokens, state_size = batch * length, B_shape[-1]
    scores = 2 * tokens * CHUNK * state_size
    within = 2 * tokens * CHUNK * heads * head_dim
    states = 4 * tokens * heads * head_dim * state_size
    forward = scores + within + states
    # The backward pass computes the scores, the states and the outputs of the states again (for the
    # gradients of the decays), and two gradients for every product.
    return forward, 3 * scores + 2 * within + 3 * states


_SCAN = Scan(
    "ssd",
    axes={"x": "B L H P", "dt": "B L H", "A": "H", "B": "B L N", "C": "B L N", "D": "H"},
    torch_backends={"chunked": ssd_chunked, "reference": ssd_reference},
    count_flops=count_flops,
    largest={"P": 128, "N": 256},
)


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
    """Scan h_t = exp(dt_t A) h_{t-1} + dt_t B_t x_t^T, y_t = C_t h_t + D x_t, per head.

    Args:
        x: inputs of H heads; P is the head_dim. For half precision, see `selective_scan`.
        dt, A, B, C, D, backend, reverse: see `selective_scan`, with heads in place of channels.
    """
    return _SCAN(ScanInputs(x, dt, A, B, C, D), backend, reverse)
