"""Selective scan of Mamba (Gu and Dao 2023, Eq. 2), which MambaVision applies within each image."""

from jaxtyping import Float
from torch import Tensor

from asysplat.ops.scan import Scan, ScanInputs
from asysplat.ops.selective_scan.reference import selective_scan_chunked, selective_scan_reference


def count_flops(x_shape: tuple[int, ...], B_shape: tuple[int, ...]) -> tuple[int, int]:
    """Count a multiplication and an addition to update each state, and as many to read it.

    The backward pass computes the states again, and four gradients.
    """
    states = x_shape[0] * x_shape[1] * x_shape[2] * B_shape[-1]
    return 4 * states, 10 * states


_SCAN = Scan(
    "selective_scan",
    axes={"x": "B L D", "dt": "B L D", "A": "D N", "B": "B L N", "C": "B L N", "D": "D"},
    torch_backends={"chunked": selective_scan_chunked, "reference": selective_scan_reference},
    count_flops=count_flops,
    largest={"N": 256},
)


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
    """Scan h_t = exp(dt_t A) h_{t-1} + dt_t B_t x_t, y_t = C_t . h_t + D x_t, per channel.

    Args:
        x: inputs; for half precision, y is computed in fp32 and returned in the type of x.
        dt: step sizes > 0, after the softplus.
        A: decay rates < 0, so that no exponent is positive.
        B, C: input and output projections, shared by the channels.
        D: skip weight of each channel.
        backend: "cpu" or "cuda", "chunked" (torch, any device and float type), "reference", or
            "auto": the kernels of the device, but "chunked" for float64 and for sizes that "cuda"
            cannot take.
        reverse: scan from the last token to the first.
    """
    return _SCAN(ScanInputs(x, dt, A, B, C, D), backend, reverse)
