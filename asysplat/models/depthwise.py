"""Convolution along the tokens, each channel by itself."""

import torch.nn.functional as F
from jaxtyping import Float
from torch import Tensor


def depthwise_conv(
    tokens: Float[Tensor, "B L C"],
    weight: Float[Tensor, "C 1 K"],
    bias: Float[Tensor, " C"] | None,
    before: int,
) -> Float[Tensor, "B L C"]:
    """Each token sees itself, the `before` tokens ahead of it and the K - 1 - before behind it.

    To torch, an image one pixel high whose channels are innermost: as a sequence, they would be
    copied outermost and back.
    """
    padded = F.pad(tokens, (0, 0, before, weight.shape[-1] - 1 - before))
    image = padded.mT.unsqueeze(-2)
    return F.conv2d(image, weight.unsqueeze(-2), bias, groups=len(weight)).squeeze(-2).mT
