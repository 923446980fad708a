"""What both scans share: checks, the choice of a backend, operators in torch, the recurrence.

The backends "reference" and "chunked" are functions in torch. "cpu" and "cuda" are modules of
kernels, registered as one operator, which autograd, torch.compile, autocast, the meta device and
the FLOP counter see whole. They take x, B and C of one float type and define:

    forward(inputs, reverse, keep) -> y and the saved state, whose sides are 0 unless `keep`
    backward(grad_output, inputs, saved_state, reverse) -> the gradients, as ScanInputs
    saved_state_shape(x, B) -> the shape of the saved state, which is what the backward pass needs
        besides the inputs, in fp32
"""

import warnings
from collections.abc import Callable, Mapping
from functools import partial
from typing import NamedTuple

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
    without_autocast,
)

AXIS_NAMES = {"P": "head_dim", "N": "state size"}  # names in messages
CountFlops = Callable[[tuple[int, ...], tuple[int, ...]], tuple[int, int]]


class ScanInputs(NamedTuple):
    """The inputs of a scan, or their gradients; shapes as in `ssd` and `selective_scan`."""

    x: Tensor
    dt: Tensor
    A: Tensor
    B: Tensor
    C: Tensor
    D: Tensor


class Scan:
    """A scan over dimension 1, in fp32 at least.

    Args:
        axes: axes of each input, such as "B L N"; the shape of x and N determine all sizes.
        count_flops: (shape of x, shape of B) -> FLOPs of the forward and of the backward pass.
        largest: greatest sizes of the axes whose size must be a power of two from 16 on for "cuda".
    """

    def __init__(
        self,
        name: str,
        axes: Mapping[str, str],
        torch_backends: Mapping[str, Callable[[ScanInputs], Tensor]],
        count_flops: CountFlops,
        largest: Mapping[str, int],
    ):
        self.name, self.torch_backends, self.largest = name, torch_backends, largest
        self.axes = {key: value.split() for key, value in axes.items()}
        self.run_kernels = _register_operator(name, count_flops)

    def __call__(self, inputs: ScanInputs, backend: str, reverse: bool) -> Tensor:
        """Return y in the type of x, scanned from the last token to the first if `reverse`."""
        self._check(inputs)
        if backend == "auto":
            backend = choose_fastest(inputs.x, "chunked", f"asysplat.ops.self_check:{self.name}")
            if backend == "cuda" and (misfit := self._misfit(inputs)):
                warnings.warn(f"{misfit}: computed by 'chunked', which is slower.", stacklevel=2)
                backend = "chunked"
        with without_autocast(inputs.x):
            if backend in KERNEL_BACKENDS:
                check_kernel_backend(self.name, backend, inputs.x)
                if backend == "cuda" and (misfit := self._misfit(inputs)):
                    raise InputError(f"{misfit}; change it, or choose backend 'chunked'.")
                keep = torch.is_grad_enabled() and any(t.requires_grad for t in inputs)
                dtype = inputs.x.dtype
                tensors = (
                    tensor.to(dtype if name in "xBC" else torch.float32).contiguous()
                    for name, tensor in inputs._asdict().items()
                )
                return self.run_kernels(backend, *tensors, reverse=reverse, keep=keep)[0]
            backends = {"auto": None, **self.torch_backends, **dict.fromkeys(KERNEL_BACKENDS)}
            implementation = look_up_backend(self.name, backends, backend)
            dtype = torch.promote_types(inputs.x.dtype, torch.float32)
            arguments = ScanInputs(*(tensor.to(dtype) for tensor in inputs))
            if not reverse:
                return implementation(arguments).to(inputs.x.dtype)
            x, dt, A, B, C, D = arguments
            flipped = ScanInputs(x.flip(1), dt.flip(1), A, B.flip(1), C.flip(1), D)
            return implementation(flipped).flip(1).to(inputs.x.dtype)

    def _misfit(self, inputs: ScanInputs) -> str | None:
        """Describe the first size that the kernels of "cuda" cannot take; None if there is none."""
        sizes = dict(zip(self.axes["x"], inputs.x.shape, strict=True)) | {"N": inputs.B.shape[-1]}
        for axis, largest in self.largest.items():
            size = sizes[axis]
            if size < 16 or size > largest or size & (size - 1):
                return (
                    f"{self.name}'s backend 'cuda' got a {AXIS_NAMES[axis]} of {size}: expected a "
                    f"power of two from 16 to {largest}"
                )
        return None

    def _check(self, inputs: ScanInputs) -> None:
        x, B, axes = inputs.x, inputs.B, self.axes["x"]
        if x.ndim != len(axes):
            check_shape(self.name, "x", x, f"[{', '.join(axes)}]")
        sizes = dict(zip(axes, x.shape, strict=True)) | {"N": B.shape[-1]}
        shapes = f"x has shape {tuple(x.shape)} and B {tuple(B.shape)}"
        for (name, axes), tensor in zip(self.axes.items(), inputs, strict=True):
            shape = tuple(sizes[axis] for axis in axes)
            check_shape(self.name, name, tensor, shape, f", as {shapes}")
            check_device(self.name, name, tensor, "x", x)
        for name, tensor in inputs._asdict().items():
            check_float(self.name, name, tensor)
        if x.numel() == 0 or B.numel() == 0:
            raise InputError(f"{self.name}'s {shapes}: every side must be at least 1.")


def _register_operator(name: str, count_flops: CountFlops) -> Callable[..., tuple[Tensor, Tensor]]:
    """Register asysplat::<name> and its backward pass with torch, and return the former."""
    tensors = "Tensor x, Tensor dt, Tensor A, Tensor B, Tensor C, Tensor D"
    kernels = partial(load_kernels, name)

    @torch.library.custom_op(
        f"asysplat::{name}",
        mutates_args=(),
        schema=f"(str backend, {tensors}, bool reverse, bool keep) -> (Tensor, Tensor)",
    )
    def forward(backend, x, dt, A, B, C, D, reverse, keep):
        return kernels(backend).forward(ScanInputs(x, dt, A, B, C, D), reverse, keep)

    @torch.library.custom_op(
        f"asysplat::{name}_backward",
        mutates_args=(),
        schema=f"(str backend, Tensor grad_output, {tensors}, Tensor saved_state, bool reverse) -> "
        "(Tensor, Tensor, Tensor, Tensor, Tensor, Tensor)",
    )
    def backward(backend, grad_output, x, dt, A, B, C, D, saved_state, reverse):
        inputs = ScanInputs(x, dt, A, B, C, D)
        return tuple(kernels(backend).backward(grad_output, inputs, saved_state, reverse))

    @forward.register_fake
    def _(backend, x, dt, A, B, C, D, reverse, keep):
        shape = kernels(backend).saved_state_shape(x, B)
        shape = shape if keep else (0,) * len(shape)
        return torch.empty_like(x), x.new_empty(shape, dtype=torch.float32)

    @backward.register_fake
    def _(backend, grad_output, x, dt, A, B, C, D, saved_state, reverse):
        return tuple(torch.empty_like(tensor) for tensor in (x, dt, A, B, C, D))

    def save(ctx, inputs, output):
        ctx.backend, *tensors, ctx.reverse, _ = inputs
        ctx.save_for_backward(*tensors, output[1])

    def gradients(ctx, grad_output, _):
        with without_autocast(grad_output):  # in which backward() may have been called
            grads = backward(ctx.backend, grad_output, *ctx.saved_tensors, ctx.reverse)
        return None, *grads, None, None

    forward.register_autograd(gradients, setup_context=save)

    @register_flop_formula(getattr(torch.ops.asysplat, name))
    def _(backend, x_shape, dt_shape, A_shape, B_shape, *_, **__) -> int:
        return count_flops(x_shape, B_shape)[0]

    @register_flop_formula(getattr(torch.ops.asysplat, f"{name}_backward"))
    def _(backend, grad_shape, x_shape, dt_shape, A_shape, B_shape, *_, **__) -> int:
        return count_flops(x_shape, B_shape)[1]

    return forward


def linear_recurrence(
    decay: Float[Tensor, "L *state"], inputs: Float[Tensor, "L *state"]
) -> Float[Tensor, "L *state"]:
    """Return all h_t = decay_t h_{t-1} + inputs_t with h_{-1} = 0; time is the first dimension.

    It is one operator of torch: the meta device and the FLOP counter see it as a whole. A step is
    one fused multiply-add; the backward pass is the same recurrence run from the end.
    """
    return _recur(decay, inputs)


@torch.library.custom_op(
    "asysplat::linear_recurrence", mutates_args=(), schema="(Tensor decay, Tensor inputs) -> Tensor"
)
def _recur(decay, inputs):
    decay, inputs = decay.contiguous(), inputs.contiguous()
    states = torch.empty_like(inputs)
    previous = torch.zeros_like(inputs[0])
    for state, factor, new in zip(states, decay, inputs, strict=True):
        previous = torch.addcmul(new, factor, previous, out=state)
    return states


@torch.library.custom_op(
    "asysplat::linear_recurrence_backward",
    mutates_args=(),
    schema="(Tensor decay, Tensor states, Tensor grad_states) -> (Tensor, Tensor)",
)
def _recur_backward(decay, states, grad_states):
    decay = decay.contiguous()
    grad_inputs = grad_states.clone(memory_format=torch.contiguous_format)
    for t in range(len(states) - 2, -1, -1):
        grad_inputs[t].addcmul_(decay[t + 1], grad_inputs[t + 1])
    grad_decay = torch.zeros_like(decay)
    torch.mul(grad_inputs[1:], states[:-1], out=grad_decay[1:])
    return grad_decay, grad_inputs


@_recur.register_fake
def _(decay, inputs):
    return inputs.new_empty(inputs.shape)


@_recur_backward.register_fake
def _(decay, states, grad_states):
    return decay.new_empty(decay.shape), states.new_empty(states.shape)


def _save_states(ctx, inputs, output):
    ctx.save_for_backward(inputs[0], output)


def _recur_gradients(ctx, grad_states):
    return _recur_backward(*ctx.saved_tensors, grad_states)


_recur.register_autograd(_recur_gradients, setup_context=_save_states)


@register_flop_formula(torch.ops.asysplat.linear_recurrence)
def _recur_flops(decay_shape, inputs_shape, *_, **__) -> int:
    return 2 * torch.Size(inputs_shape).numel()


@register_flop_formula(torch.ops.asysplat.linear_recurrence_backward)
def _recur_backward_flops(decay_shape, states_shape, *_, **__) -> int:
    return 3 * torch.Size(states_shape).numel()
