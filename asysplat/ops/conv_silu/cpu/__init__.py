"""The convolution for CPUs (Numba): a task takes bands of tokens, one token after the other.

The channels of a token are computed sixteen at a time, and the K tokens that they are computed of
stay in the cache. A band's gradients also need the tokens just before and after the band, whose
convolutions are computed again.
"""

import torch
from jaxtyping import Float
from torch import Tensor

from asysplat.kernels.simd.threads import even_bounds, run_blocks
from asysplat.ops.conv_silu.cpu.kernels import (
    BAND,
    Sequences,
    Taps,
    backward_bands,
    forward_bands,
)


def forward(
    tokens: Float[Tensor, "B L C"],
    weight: Float[Tensor, "C K"],
    bias: Float[Tensor, " C"] | None,
    before: int,
) -> Float[Tensor, "B L C"]:
    """Return the silu of the convolution; see `asysplat.ops.conv_silu`."""
    y = torch.empty(tokens.shape)
    run_blocks(
        forward_bands,
        even_bounds(_count_bands(tokens)),
        _view_sequences(tokens),
        _arrange_taps(weight, bias, before),
        y.view(-1).numpy(),
    )
    return y.to(tokens.dtype)


def backward(
    grad_output: Float[Tensor, "B L C"],
    tokens: Float[Tensor, "B L C"],
    weight: Float[Tensor, "C K"],
    bias: Float[Tensor, " C"] | None,
    before: int,
) -> tuple[Float[Tensor, "B L C"], Float[Tensor, "C K"], Float[Tensor, " C"]]:
    """Return the gradients of tokens, weight and bias."""
    (channels, size), bands = weight.shape, _count_bands(tokens)
    grad_tokens = torch.empty(tokens.shape)
    parts = torch.empty(bands, size + 1, channels)
    run_blocks(
        backward_bands,
        even_bounds(bands),
        _view_sequences(tokens),
        _view_sequences(grad_output),
        _arrange_taps(weight, bias, before),
        grad_tokens.view(-1).numpy(),
        parts.view(bands, -1).numpy(),
    )
    *grad_weight, grad_bias = parts.sum(0)
    return grad_tokens.to(tokens.dtype), torch.stack(grad_weight, -1), grad_bias.clone()


def _count_bands(tokens: Float[Tensor, "B L C"]) -> int:
    return len(tokens) * -(-tokens.shape[1] // BAND)


def _view_sequences(tokens: Float[Tensor, "B L C"]) -> Sequences:
    tokens = tokens.float()
    if tokens.stride(-1) != 1:
        tokens = tokens.contiguous()
    (batch, length, channels), (sequence_stride, stride, _) = tokens.shape, tokens.stride()
    span = (batch - 1) * sequence_stride + (length - 1) * stride + channels
    numbers = tokens.as_strided((span,), (1,)).numpy()
    return Sequences(numbers, length, channels, sequence_stride, stride)


def _arrange_taps(weight: Tensor, bias: Tensor | None, before: int) -> Taps:
    # Copies, as FSDP frees the storage of a weight, which NumPy would keep from being resized.
    bias = weight.new_zeros(len(weight)) if bias is None else bias.clone()
    rows = weight.T.clone(memory_format=torch.contiguous_format).numpy()
    return Taps(tuple(rows), bias.numpy(), before)
