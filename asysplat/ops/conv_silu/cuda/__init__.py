"""The convolution for GPUs (Triton): a program takes a block of channels and a band of tokens.

Each lane keeps its channels of neighboring tokens in registers: of the whole band, all loaded at
once, or in the backward pass of a step of tokens and those before it. The backward pass reads each
token and each gradient once, but for those just outside of a band, and writes each band's part of
the gradients of the weights and the bias.
"""

import math

import torch
import triton
from jaxtyping import Float
from torch import Tensor

from asysplat.kernels.triton_utils import FUSED, INTERPRETED
from asysplat.ops.conv_silu.cuda.kernels import backward_band, forward_band

# Tokens of a forward band and of a step of the backward pass, and the steps of its bands.
FORWARD_BAND, STEP, STEPS = (4, 2, 2) if INTERPRETED else (32, 8, 16)
BLOCK = 128  # channels of a program, two of each lane
LAUNCH = {"BLOCK": BLOCK, "num_warps": 2, **FUSED}


def forward(
    tokens: Float[Tensor, "B L C"],
    weight: Float[Tensor, "C K"],
    bias: Float[Tensor, " C"] | None,
    before: int,
) -> Float[Tensor, "B L C"]:
    """Return the silu of the convolution; see `asysplat.ops.conv_silu`."""
    tokens, unit = _find_unit(tokens)
    y = tokens.new_empty(tokens.shape)
    with torch.cuda.device_of(tokens):
        forward_band[_grid(tokens, FORWARD_BAND)](
            *(tokens, weight.contiguous(), bias, y),
            *_sizes(tokens, unit),
            UNIT=unit,
            SIZE=weight.shape[1],
            BEFORE=before,
            BAND=FORWARD_BAND,
            **LAUNCH,
        )
    return y


def backward(
    grad_output: Float[Tensor, "B L C"],
    tokens: Float[Tensor, "B L C"],
    weight: Float[Tensor, "C K"],
    bias: Float[Tensor, " C"] | None,
    before: int,
) -> tuple[Float[Tensor, "B L C"], Float[Tensor, "C K"], Float[Tensor, " C"]]:
    """Return the gradients of tokens, weight and bias."""
    (tokens, unit), (grad_output, g_unit) = _find_unit(tokens), _find_unit(grad_output)
    grad_tokens = tokens.new_empty(tokens.shape)
    (channels, size), grid = weight.shape, _grid(tokens, STEP * STEPS)
    parts = weight.new_empty(grid[2], grid[0], size + 1, channels)
    with torch.cuda.device_of(tokens):
        backward_band[grid](
            *(tokens, grad_output, weight.contiguous(), bias, grad_tokens, parts),
            *(*_sizes(tokens, unit), *_sizes(grad_output, g_unit)[:2]),
            UNIT=unit,
            G_UNIT=g_unit,
            SIZE=size,
            BEFORE=before,
            STEP=STEP,
            STEPS=STEPS,
            **LAUNCH,
        )
    sums = parts.sum((0, 1))
    return grad_tokens, sums[:size].T.contiguous(), sums[size].clone()


def _find_unit(tokens: Float[Tensor, "B L C"]) -> tuple[Float[Tensor, "B L C"], int]:
    """Return tokens with neighboring channels, and a power of two that divides their strides.

    Triton knows of a number whether 16 divides it. With the unit it can load several channels at
    once where the tokens lie in rows of, say, 4124 numbers.
    """
    if tokens.stride(2) != 1:
        tokens = tokens.contiguous()
    return tokens, math.gcd(16, *tokens.stride()[:2])


def _sizes(tokens: Float[Tensor, "B L C"], unit: int) -> tuple[int, int, int, int]:
    """Return the strides of sequences and tokens in units, the length, and the channels."""
    strides = (stride // unit for stride in tokens.stride()[:2])
    return *strides, *tokens.shape[1:]


def _grid(tokens: Float[Tensor, "B L C"], band: int) -> tuple[int, int, int]:
    batch, length, channels = tokens.shape
    return triton.cdiv(length, band), triton.cdiv(channels, BLOCK), batch
