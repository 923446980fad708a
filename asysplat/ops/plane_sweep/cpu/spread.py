"""Sums along rows and columns on CPUs: a task takes a view, all numbers of a pixel at a time."""

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from asysplat.kernels.simd.threads import even_bounds, inline, kernel, run_blocks
from asysplat.kernels.simd.vectors import LANES, fma, load_some, store_some, zeros
from asysplat.ops.plane_sweep import reference


def spread(
    values: Float[Tensor, "B V h w C"], keep: Float[Tensor, "B V 2 h w"]
) -> Float[Tensor, "B V h w C"]:
    """Compute the sums in float32, of at most LANES numbers a pixel; see `reference.spread`."""
    sums = values.clone(memory_format=torch.contiguous_format)
    arrays = sums.flatten(0, 1).numpy(), keep.flatten(0, 1).contiguous().numpy()
    run_blocks(spread_views, even_bounds(len(arrays[0])), *arrays, reference.SPREAD_ROUNDS)
    return sums


@kernel
def spread_views(start, stop, sums, keep, rounds):
    """Replace the values of the views start to stop, [n, h, w, C], by their sums."""
    h, w, numbers = sums.shape[1:]
    line = np.empty((max(h, w), LANES), np.float32)
    for n in range(start, stop):
        for _ in range(rounds):
            for y in range(h):
                _spread_line(sums[n, y], keep[n, 0, y], line, numbers)
            for x in range(w):
                _spread_line(sums[n, :, x], keep[n, 1, :, x], line, numbers)


@inline
def _spread_line(values, keep, line, numbers):
    """Add to each pixel's numbers what reaches it from before, then what does from behind."""
    before = zeros()
    for k in range(len(values)):
        before = fma(before, keep[k], load_some(values[k], 0, numbers))
        store_some(line[k], 0, LANES, before)
    behind = zeros()
    for k in range(len(values) - 1, -1, -1):
        value = load_some(values[k], 0, numbers)
        store_some(values[k], 0, numbers, load_some(line[k], 0, LANES) + behind)
        behind = (behind + value) * keep[k]
