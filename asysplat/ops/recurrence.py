"""The first-order linear recurrence of both scans, as one operator of torch.

The meta device and the FLOP counter see the operator as a whole, not token by token.
"""

import torch
from jaxtyping import Float
from torch import Tensor
from torch.utils.flop_counter import register_flop_formula


def linear_recurrence(
    decay: Float[Tensor, "L *state"], inputs: Float[Tensor, "L *state"]
) -> Float[Tensor, "L *state"]:
    """Return all h_t = decay_t h_{t-1} + inputs_t with h_{-1} = 0; time is the first dimension.

    A step is one fused multiply-add; the backward pass is the same recurrence run from the end.
    """
    return _forward(decay, inputs)


@torch.library.custom_op(
    "asysplat::linear_recurrence", mutates_args=(), schema="(Tensor decay, Tensor inputs) -> Tensor"
)
def _forward(decay, inputs):
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
def _backward(decay, states, grad_states):
    decay = decay.contiguous()
    grad_inputs = grad_states.clone(memory_format=torch.contiguous_format)
    for t in range(len(states) - 2, -1, -1):
        grad_inputs[t].addcmul_(decay[t + 1], grad_inputs[t + 1])
    grad_decay = torch.zeros_like(decay)
    torch.mul(grad_inputs[1:], states[:-1], out=grad_decay[1:])
    return grad_decay, grad_inputs


@_forward.register_fake
def _(decay, inputs):
    return inputs.new_empty(inputs.shape)


@_backward.register_fake
def _(decay, states, grad_states):
    return decay.new_empty(decay.shape), states.new_empty(states.shape)


def _save(ctx, inputs, output):
    ctx.save_for_backward(inputs[0], output)


def _gradients(ctx, grad_states):
    return _backward(*ctx.saved_tensors, grad_states)


_forward.register_autograd(_gradients, setup_context=_save)


@register_flop_formula(torch.ops.asysplat.linear_recurrence)
def _flops(decay_shape, inputs_shape, *_, **__) -> int:
    return 2 * torch.Size(inputs_shape).numel()


@register_flop_formula(torch.ops.asysplat.linear_recurrence_backward)
def _backward_flops(decay_shape, states_shape, *_, **__) -> int:
    return 3 * torch.Size(states_shape).numel()
