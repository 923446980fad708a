"""The convolution by its formula in torch, for any device and float type."""

import torch.nn.functional as F
from jaxtyping import Float
from torch import Tensor


def conv_silu_reference(
    tokens: Float[Tensor, "B L C"],
    weight: Float[Tensor, "C K"],
    bias: Float[Tensor, " C"] | None,
    before: int,
) -> Float[Tensor, "B L C"]:
    """Compute the silu of the convolution; see `asysplat.ops.conv_silu`."""
    length, size = tokens.shape[1], weight.shape[1]
    padded = F.pad(tokens, (0, 0, before, size - 1 - before))
    # Not torch's convolution: cuDNN would round its factors to TF32.
    taps = sum(padded[:, k : k + length] * weight[:, k] for k in range(size))
    return F.silu(taps if bias is None else taps + bias)
