"""Depthwise convolution along the tokens."""

import torch
import torch.nn.functional as F
from jaxtyping import Float
from torch import Tensor
from torch.autograd.function import once_differentiable

from asysplat.kernels.dispatch import without_autocast


def depthwise_conv(
    tokens: Float[Tensor, "B L C"],
    weight: Float[Tensor, "C 1 K"],
    bias: Float[Tensor, " C"] | None,
    before: int,
) -> Float[Tensor, "B L C"]:
    """Convolve each token with `before` tokens before it and K - 1 - before tokens after it.

    The result has the tokens' type.
    """
    with without_autocast(tokens):
        bias = None if bias is None else bias.to(tokens.dtype)
        return _DepthwiseConv.apply(tokens, weight.to(tokens.dtype), bias, before)


class _DepthwiseConv(torch.autograd.Function):
    """With its own backward pass: torch computes the weights' gradient slowly on a CPU."""

    @staticmethod
    def forward(ctx, tokens, weight, bias, before):
        ctx.save_for_backward(tokens, weight)
        ctx.before, ctx.has_bias = before, bias is not None
        return _convolve(tokens, weight, bias, before)

    @staticmethod
    @once_differentiable
    def backward(ctx, grad_output):
        tokens, weight = ctx.saved_tensors
        length, size, before = tokens.shape[1], weight.shape[-1], ctx.before
        with without_autocast(tokens):
            grad_tokens = _convolve(grad_output, weight.flip(-1), None, size - 1 - before)
        padded = _pad(tokens, size, before)
        grad_output = grad_output.to(torch.promote_types(grad_output.dtype, torch.float32))
        taps = [(padded[:, k : k + length] * grad_output).sum((0, 1)) for k in range(size)]
        grad_weight = torch.stack(taps, -1)[:, None].to(weight.dtype)
        grad_bias = grad_output.sum((0, 1)).to(weight.dtype) if ctx.has_bias else None
        return grad_tokens, grad_weight, grad_bias, None


def _convolve(tokens: Tensor, weight: Tensor, bias: Tensor | None, before: int) -> Tensor:
    """Convolve the tokens as an image one pixel high.

    An image's channels may be innermost in memory; torch would copy those of a sequence.
    """
    image = _pad(tokens, weight.shape[-1], before).mT.unsqueeze(-2)
    return F.conv2d(image, weight.unsqueeze(-2), bias, groups=len(weight)).squeeze(-2).mT


def _pad(tokens: Tensor, size: int, before: int) -> Tensor:
    return F.pad(tokens, (0, 0, before, size - 1 - before))
