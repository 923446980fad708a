"""Adam by its formulas in torch, for any device and float type."""

import math
from collections.abc import Sequence
from functools import cache
from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Bool, Float, Int32
from numpy import ndarray
from torch import Tensor

ROUNDING = 2.0**-25  # number so small that 1 - ROUNDING is rounded to 1 in float32


class Rows(NamedTuple):
    """A tensor of N rows of K numbers, with its gradient and the state of Adam."""

    parameter: Float[Tensor, "N K"]  # updated in place, like `mean`, `square` and `steps`
    gradient: Float[Tensor, "N K"]
    mean: Float[Tensor, "N K"]  # decaying average of the gradient
    square: Float[Tensor, "N K"]  # decaying average of its square
    steps: Int32[Tensor, "N"]  # number of updates of each row so far
    rates: Float[Tensor, "K"]  # learning rate of each number of a row, >= 0


class AdamSettings(NamedTuple):
    """The settings of Adam."""

    beta1: float  # decay of `mean` per step, in [0, 1)
    beta2: float  # decay of `square` per step, in [0, 1)
    eps: float  # number > 0 that is added to the root of the corrected square


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


@cache
def tabulate_corrections(settings: AdamSettings) -> Float[ndarray, "steps 2"]:
    """Tabulate 1 / (1 - beta1^t) and 1 / sqrt(1 - beta2^t) up to the step t where both are 1."""
    slowest = max(settings.beta1, settings.beta2, ROUNDING)
    t = np.arange(2 + math.ceil(math.log(ROUNDING) / math.log(slowest)))
    t[0] = 1  # unused: a row's first step is 1
    first, second = 1 - settings.beta1**t, 1 - settings.beta2**t
    return np.stack((1 / first, 1 / np.sqrt(second)), -1).astype(np.float32)
