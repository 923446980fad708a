"""The convolution of Mamba's blocks: each channel along its sequence, followed by silu.

The kernels of "cpu" and "cuda" are registered as one operator, which autograd, torch.compile,
autocast, the meta device and the FLOP counter see whole. It saves its inputs alone: the backward
pass computes the convolution again. Both modules define:

    forward(inputs) -> y
    backward(grad_output, inputs) -> the gradients of tokens, weight and bias
"""

from functools import partial

import torch
from jaxtyping import Float
from torch import Tensor
from torch.utils.flop_counter import register_flop_formula

from asysplat.errors import InputError
from asysplat.kernels.dispatch import (
    KERNEL_BACKENDS,
    check_device,
    check_float,
    check_kernel_backend,
    check_shape,
    choose_fastest,
    load_kernels,
    look_up_backend,
)
from asysplat.ops.conv_silu.reference import conv_silu_reference

_kernels = partial(load_kernels, "conv_silu")


def conv_silu(
    tokens: Float[Tensor, "B L C"],
    weight: Float[Tensor, "C K"],
    bias: Float[Tensor, " C"] | None,
    before: int,
    backend: str = "auto",
) -> Float[Tensor, "B L C"]:
    """Compute silu(bias + sum_k weight_k tokens_{t - before + k}), per channel.

    Tokens before the first and after the last are zeros.

    Args:
        tokens: inputs; half precision is computed in fp32 and returned in the type of tokens. The
            kernels read a slice of the channels of a wider tensor where it is.
        weight: K weights of each channel.
        bias: added before the silu.
        before: how many of the K tokens precede token t; the others are itself and those after it.
        backend: "cpu", "cuda", "reference" (torch, any device and float type), or "auto": the
            kernels of the device, but "reference" for float64.
    """
    _check(tokens, weight, bias, before)
    if backend == "auto":
        backend = choose_fastest(tokens, "reference", "asysplat.ops.self_check:conv_silu")
    if backend in KERNEL_BACKENDS:
        check_kernel_backend("conv_silu", backend, tokens)
        bias = None if bias is None else bias.float()
        return _run_kernels(backend, tokens, weight.float(), bias, before)
    backends = {"auto": None, "reference": conv_silu_reference, **dict.fromkeys(KERNEL_BACKENDS)}
    implementation = look_up_backend("conv_silu", backends, backend)
    dtype = torch.promote_types(tokens.dtype, torch.float32)
    bias = None if bias is None else bias.to(dtype)
    return implementation(tokens.to(dtype), weight.to(dtype), bias, before).to(tokens.dtype)


def _check(tokens: Tensor, weight: Tensor, bias: Tensor | None, before: int) -> None:
    if tokens.ndim != 3:
        check_shape("conv_silu", "tokens", tokens, "[B, L, C]")
    if weight.ndim != 2:
        check_shape("conv_silu", "weight", weight, "[C, K]")
    channels, size = tokens.shape[2], weight.shape[1]
    reason = f", as tokens has shape {tuple(tokens.shape)}"
    shapes = {"weight": (weight, (channels, size)), "bias": (bias, (channels,))}
    for name, (tensor, shape) in shapes.items():
        if tensor is not None:
            check_shape("conv_silu", name, tensor, shape, reason)
            check_device("conv_silu", name, tensor, "tokens", tokens)
            check_float("conv_silu", name, tensor)
    check_float("conv_silu", "tokens", tokens)
    if tokens.numel() == 0:
        raise InputError(
            f"conv_silu's tokens has shape {tuple(tokens.shape)}: every side must be at least 1."
        )
    if not 0 <= before < size:
        raise InputError(f"conv_silu got before={before}: give a number from 0 to {size - 1}.")


@torch.library.custom_op(
    "asysplat::conv_silu",
    mutates_args=(),
    schema="(str backend, Tensor tokens, Tensor weight, Tensor? bias, int before) -> Tensor",
)
def _run_kernels(backend, tokens, weight, bias, before):
    return _kernels(backend).forward(tokens, weight, bias, before)


@torch.library.custom_op(
    "asysplat::conv_silu_backward",
    mutates_args=(),
    schema="(str backend, Tensor grad_output, Tensor tokens, Tensor weight, Tensor? bias, "
    "int before) -> (Tensor, Tensor, Tensor)",
)
def _run_backward(backend, grad_output, tokens, weight, bias, before):
    return _kernels(backend).backward(grad_output, tokens, weight, bias, before)


@_run_kernels.register_fake
def _(backend, tokens, weight, bias, before):
    return tokens.new_empty(tokens.shape)


@_run_backward.register_fake
def _(backend, grad_output, tokens, weight, bias, before):
    shapes = weight.shape, weight.shape[:1]
    return tokens.new_empty(tokens.shape), *map(weight.new_empty, shapes)


def _save(ctx, inputs, output):
    ctx.backend, tokens, weight, bias, ctx.before = inputs
    ctx.save_for_backward(tokens, weight, bias)


def _gradients(ctx, grad_output):
    tokens, weight, bias = ctx.saved_tensors
    grads = _run_backward(ctx.backend, grad_output, tokens, weight, bias, ctx.before)
    grad_tokens, grad_weight, grad_bias = grads
    return None, grad_tokens, grad_weight, None if bias is None else grad_bias, None


_run_kernels.register_autograd(_gradients, setup_context=_save)


@register_flop_formula(torch.ops.asysplat.conv_silu)
def _flops(backend, tokens_shape, weight_shape, *_, **__) -> int:
    return 2 * torch.Size(tokens_shape).numel() * weight_shape[1]


@register_flop_formula(torch.ops.asysplat.conv_silu_backward)
def _backward_flops(backend, grad_shape, tokens_shape, weight_shape, *_, **__) -> int:
    # The convolution again, and two gradients.
    return 3 * _flops(backend, tokens_shape, weight_shape)
