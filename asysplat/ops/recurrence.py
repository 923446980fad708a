"""The first-order linear recurrence that both scans come down to."""

import torch
from jaxtyping import Float
from torch import Tensor


def linear_recurrence(
    decay: Float[Tensor, "L *state"], inputs: Float[Tensor, "L *state"]
) -> Float[Tensor, "L *state"]:
    """h_t = decay_t h_{t-1} + inputs_t with h_{-1} = 0; time is the first dimension.

    One fused multiply-add a step, and a backward that is the same recurrence run from the end.
    """
    return _LinearRecurrence.apply(decay, inputs)


class _LinearRecurrence(torch.autograd.Function):
    @staticmethod
    def forward(ctx, decay: Tensor, inputs: Tensor) -> Tensor:
        decay, inputs = decay.contiguous(), inputs.contiguous()
        states = torch.empty_like(inputs)
        previous = torch.zeros_like(inputs[0])
        for state, factor, new in zip(states, decay, inputs, strict=True):
            previous = torch.addcmul(new, factor, previous, out=state)
        ctx.save_for_backward(decay, states)
        return states

    @staticmethod
    def backward(ctx, grad_states: Tensor) -> tuple[Tensor, Tensor]:
        decay, states = ctx.saved_tensors
        grad_inputs = grad_states.contiguous().clone()
        for t in range(len(states) - 2, -1, -1):
            grad_inputs[t].addcmul_(decay[t + 1], grad_inputs[t + 1])
        grad_decay = torch.zeros_like(decay)
        torch.mul(grad_inputs[1:], states[:-1], out=grad_decay[1:])
        return grad_decay, grad_inputs
