"""The smoothed costs and their least: a task takes a view, down its rows and up again."""

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from asysplat.ops.cpu.kernel import inline, kernel
from asysplat.ops.cpu.threads import even_bounds, run_blocks
from asysplat.ops.cpu.vectors import (
    LANES,
    ZERO,
    least,
    load,
    load_some,
    store,
    store_some,
    zeros,
)
from asysplat.ops.plane_sweep import reference

SMALL_STEP = np.float32(reference.SMALL_STEP)
FLATTEST = np.float32(reference.FLATTEST)
HALF = np.float32(0.5)
INFINITY = np.float32(np.inf)


def smooth(
    costs: Float[Tensor, "B V h w D"],
    weights: Float[Tensor, "B V h w"],
    edges: Float[Tensor, "B V 2 h w"],
) -> reference.Lowest:
    """Find the plane of least smoothed cost; see `reference.smooth`."""
    found = reference.Lowest(torch.empty(weights.shape), torch.empty(weights.shape))
    run_blocks(
        smooth_views,
        even_bounds(weights.shape[0] * weights.shape[1]),
        costs.flatten(0, 1).contiguous().numpy(),
        weights.clamp_min(reference.LEAST_WEIGHT).flatten(0, 1).contiguous().numpy(),
        (reference.LARGE_STEP / (1 + edges / reference.EDGE)).flatten(0, 1).contiguous().numpy(),
        *(each.flatten(0, 1).numpy() for each in found),
    )
    return found


@kernel
def smooth_views(start, stop, costs, weights, penalties, plane, contrast):
    """Write the planes of the views start to stop, and the contrasts.

    Args:
        costs: [n, h, w, D].
        weights: [n, h, w], of a pixel's costs.
        penalties: [n, 2, h, w], of a step of several planes from the left and from above.
        plane, contrast: [n, h, w].
    """
    h, w, planes = costs.shape[1:]
    vectors = -(-planes // LANES)
    weighted = np.empty((h, w, vectors * LANES), np.float32)
    total = np.empty((h, w, vectors, LANES), np.float32)
    # Costs of the paths to a pixel and to the one before: infinite on both sides of the planes.
    size = vectors * LANES + 2
    along = np.full((2, size), INFINITY, np.float32)
    across = np.full((2, w, size), INFINITY, np.float32)
    lows = np.empty(w, np.float32)
    for n in range(start, stop):
        for y in range(h):
            for x in range(w):
                for d in range(planes):
                    weighted[y, x, d] = costs[n, y, x, d] * weights[n, y, x]
                weighted[y, x, planes:] = INFINITY
        left, above = penalties[n]
        across[1, :, 1:-1] = ZERO  # a path begins where all planes cost nothing
        lows[:] = ZERO
        for y in range(h):
            along[1, 1:-1] = ZERO
            low = ZERO
            for x in range(w):
                old, new = along[(x + 1) % 2], along[x % 2]
                low = _go_on(old, new, low, weighted[y, x], left[y, x])
                for v in range(vectors):
                    store(total[y, x], v, load_some(new, 1 + v * LANES, LANES))
            along[w % 2, 1:-1] = ZERO
            low = ZERO
            for x in range(w - 1, -1, -1):
                old, new = along[(x + 1) % 2], along[x % 2]
                low = _go_on(old, new, low, weighted[y, x], left[y, min(x + 1, w - 1)])
                old, down = across[(y + 1) % 2, x], across[y % 2, x]
                lows[x] = _go_on(old, down, lows[x], weighted[y, x], above[y, x])
                for v in range(vectors):
                    place = 1 + v * LANES
                    both = load_some(new, place, LANES) + load_some(down, place, LANES)
                    store(total[y, x], v, load(total[y, x], v) + both)
        across[h % 2, :, 1:-1] = ZERO
        lows[:] = ZERO
        for y in range(h - 1, -1, -1):
            for x in range(w):
                old, up = across[(y + 1) % 2, x], across[y % 2, x]
                lows[x] = _go_on(old, up, lows[x], weighted[y, x], above[min(y + 1, h - 1), x])
                best = load_some(up, 1, LANES) + load(total[y, x], 0)
                for v in range(vectors):
                    value = load_some(up, 1 + v * LANES, LANES) + load(total[y, x], v)
                    store(total[y, x], v, value)
                    best = min(best, value)
                costs_here, lowest = total[y, x].ravel(), least(best)
                plane[n, y, x] = _between(costs_here, lowest, planes)
                contrast[n, y, x] = costs_here[:planes].mean() - lowest


@inline
def _go_on(old, new, low, cost, step):
    """Write what the paths to a pixel cost, from those to the one before; return the least.

    Args:
        old, new: a place more at both ends than there are planes.
        low: the least of `old`.
        cost: of the pixel's planes.
        step: the penalty for several planes more or less.
    """
    far, lowest = low + step, INFINITY + zeros()
    for d in range(0, len(cost), LANES):
        one = min(load_some(old, d, LANES), load_some(old, d + 2, LANES)) + SMALL_STEP
        path = min(min(load_some(old, d + 1, LANES), one), far)
        path = load_some(cost, d, LANES) + (path - low)
        store_some(new, d + 1, LANES, path)
        lowest = min(lowest, path)
    return least(lowest)


@inline
def _between(costs, lowest, planes):
    """Return the place of the lowest cost, moved to the minimum of the parabola through three."""
    best = 0
    while costs[best] > lowest:
        best += 1
    shift = ZERO
    if 0 < best < planes - 1:
        before, after = costs[best - 1], costs[best + 1]
        bend = before + after - 2 * costs[best]
        if bend > FLATTEST:
            shift = min(max((before - after) / (2 * bend), -HALF), HALF)
    return best + shift
