"""A scan's fast forms as one operator to torch, so that autograd, torch.compile, autocast, the meta
device and the FLOP counter see it as a whole."""

from collections.abc import Callable
from importlib import import_module
from types import ModuleType

import torch
from torch import Tensor
from torch.utils.flop_counter import register_flop_formula

SIGNATURE = "Tensor x, Tensor dt, Tensor A, Tensor B, Tensor C, Tensor D"


def scan_operator(
    scan: str, count_flops: Callable[[tuple[int, ...], tuple[int, ...]], tuple[int, int]]
) -> Callable[..., Tensor]:
    """(form, x, dt, A, B, C, D, reverse) -> y, by the module asysplat.ops.<scan>.<form>.

    Such a module has three functions:

    carried_shape(x, B) -> shape in fp32 of what the backward pass needs besides the inputs
    forward(x, dt, A, B, C, D, reverse, keep) -> (y, carried), with sides of 0 if not to be kept
    backward(grad_y, x, dt, A, B, C, D, carried, reverse) -> gradients of x, dt, A, B, C, D

    Args:
        scan: "ssd" or "selective_scan".
        count_flops: of the forward and the backward pass, from the shapes of x and B.
    """
    name = f"asysplat::{scan}"
    forward = torch.library.custom_op(
        name,
        mutates_args=(),
        schema=f"(str form, {SIGNATURE}, bool reverse, bool keep) -> (Tensor, Tensor)",
    )(lambda form, *args: _module(scan, form).forward(*args))
    backward = torch.library.custom_op(
        f"{name}_backward",
        mutates_args=(),
        schema=f"(str form, Tensor grad_y, {SIGNATURE}, Tensor carried, bool reverse) -> "
        "(Tensor, Tensor, Tensor, Tensor, Tensor, Tensor)",
    )(lambda form, *args: _module(scan, form).backward(*args))

    @forward.register_fake
    def _(form, x, dt, A, B, C, D, reverse, keep):
        shape = _module(scan, form).carried_shape(x, B)
        shape = shape if keep else (0,) * len(shape)
        return torch.empty_like(x), x.new_empty(shape, dtype=torch.float32)

    @backward.register_fake
    def _(form, grad_y, x, dt, A, B, C, D, carried, reverse):
        return tuple(torch.empty_like(tensor) for tensor in (x, dt, A, B, C, D))

    def save(ctx, inputs, output):
        ctx.form, *tensors, ctx.reverse, _ = inputs
        ctx.save_for_backward(*tensors, output[1])

    def gradients(ctx, grad_y, _):
        return None, *backward(ctx.form, grad_y, *ctx.saved_tensors, ctx.reverse), None, None

    forward.register_autograd(gradients, setup_context=save)
    operators = torch.ops.asysplat

    @register_flop_formula(getattr(operators, scan))
    def _(form, x_shape, dt_shape, A_shape, B_shape, *_, **__) -> int:
        return count_flops(x_shape, B_shape)[0]

    @register_flop_formula(getattr(operators, f"{scan}_backward"))
    def _(form, grad_shape, x_shape, dt_shape, A_shape, B_shape, *_, **__) -> int:
        return count_flops(x_shape, B_shape)[1]

    def run(form: str, *args: Tensor | bool) -> Tensor:
        *tensors, reverse = args
        keep = torch.is_grad_enabled() and any(tensor.requires_grad for tensor in tensors)
        return forward(form, *tensors, reverse, keep)[0]

    return run


def _module(scan: str, form: str) -> ModuleType:
    """Imported when first used: it may need Numba's or Triton's compiler."""
    return import_module(f"asysplat.ops.{scan}.{form}")
