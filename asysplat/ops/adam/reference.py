"""Adam by its formulas in torch, for any device and float type."""

from collections.abc import Sequence
from typing import NamedTuple

import torch
from jaxtyping import Bool, Float, Int32
from torch import Tensor


class Rows(NamedTuple):
    """A tensor of N rows of K numbers, with its gradient and the state of Adam.

    Args:
        parameter: updated in place, like `mean`, `square` and `steps`.
        gradient: gradient of the loss.
        mean, square: decaying averages of the gradient and of its square.
        steps: number of updates of each row so far.
        rates: learning rate of each number of a row, >= 0.
    """

    parameter: Float[Tensor, "N K"]
    gradient: Float[Tensor, "N K"]
    mean: Float[Tensor, "N K"]
    square: Float[Tensor, "N K"]
    steps: Int32[Tensor, "N"]
    rates: Float[Tensor, "K"]


class AdamSettings(NamedTuple):
    """The settings of Adam.

    Args:
        beta1, beta2: decay of `mean` and `square` per step, in [0, 1).
        eps: number > 0 that is added to the root of the corrected square.
    """

    beta1: float
    beta2: float
    eps: float


def adam_step_reference(
    tensors: Sequence[Rows], visible: Bool[Tensor, "N"], settings: AdamSettings
) -> int:
    """Update the visible rows; see `asysplat.ops.adam.adam_step`."""
    finite = torch.stack([rows.gradient.isfinite().all(1) for rows in tensors]).all(0)
    index = (visible & finite).nonzero().squeeze(1)
    for parameter, gradient, mean, square, steps, rates in tensors:
        steps[index] += 1
        t = steps[index, None].to(parameter.dtype)
        g = gradient[index]
        mean[index] = settings.beta1 * mean[index] + (1 - settings.beta1) * g
        square[index] = settings.beta2 * square[index] + (1 - settings.beta2) * g * g
        corrected_mean = mean[index] / (1 - settings.beta1**t)
        corrected_square = square[index] / (1 - settings.beta2**t)
        parameter[index] -= rates * corrected_mean / (corrected_square.sqrt() + settings.eps)
    return int((visible & ~finite).sum())
