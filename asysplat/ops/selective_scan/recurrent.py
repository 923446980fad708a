"""The selective scan with everything but the recurrence itself done for all tokens at once."""

import torch
from jaxtyping import Float
from torch import Tensor

from asysplat.ops.recurrence import linear_recurrence


def selective_scan_recurrent(
    x: Float[Tensor, "B L D"],
    dt: Float[Tensor, "B L D"],
    A: Float[Tensor, "D N"],
    B: Float[Tensor, "B L N"],
    C: Float[Tensor, "B L N"],
    D: Float[Tensor, "D"],
) -> Float[Tensor, "B L D"]:
    """See `asysplat.ops.selective_scan`."""
    # Time comes first, so that each step of the recurrence reads contiguous memory.
    xs, dts, Bs, Cs = (tensor.transpose(0, 1) for tensor in (x, dt, B, C))
    decay = torch.exp(dts[..., None] * A)
    inputs = (dts * xs)[..., None] * Bs[..., None, :]
    states = linear_recurrence(decay, inputs)
    y = (states @ Cs[..., None]).squeeze(-1)
    return torch.addcmul(y, xs, D).transpose(0, 1)
