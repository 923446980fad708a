"""SGM on CPUs: a task takes a view, one direction of its paths after the other."""

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from asysplat.kernels.simd.threads import even_bounds, inline, kernel, run_blocks
from asysplat.kernels.simd.vectors import (
    LANES,
    ZERO,
    least,
    less,
    load_some,
    store_some,
    total,
    where,
    zeros,
)
from asysplat.ops.plane_sweep import reference

SMALL_STEP = np.float32(reference.SMALL_STEP)
MIN_BEND = np.float32(reference.MIN_BEND)
HALF = np.float32(0.5)
INFINITY = np.float32(np.inf)


def sgm(
    costs: Float[Tensor, "B V h w D"],
    weights: Float[Tensor, "B V h w"],
    edges: Float[Tensor, "B V 2 h w"],
) -> reference.BestPlane:
    """Aggregate the costs in float32; see `reference.sgm`."""
    best = reference.BestPlane(torch.empty(weights.shape), torch.empty(weights.shape))
    run_blocks(
        aggregate_views,
        even_bounds(weights.shape[0] * weights.shape[1]),
        costs.flatten(0, 1).contiguous().numpy(),
        weights.clamp_min(reference.MIN_WEIGHT).flatten(0, 1).contiguous().numpy(),
        (reference.LARGE_STEP / (1 + edges / reference.EDGE)).flatten(0, 1).contiguous().numpy(),
        *(field.flatten(0, 1).numpy() for field in best),
    )
    return best


@kernel
def aggregate_views(start, stop, costs, weights, penalties, plane, contrast):
    """Write the planes and contrasts, [n, h, w], of the views start to stop.

    `penalties` [n, 2, h, w] are for a step of several planes, from the pixel on the left and from
    the pixel above.
    """
    h, w, planes = costs.shape[1:]
    vectors = -(-planes // LANES)
    weighted = np.empty((h, w, vectors * LANES), np.float32)
    sums = np.empty((h, w, vectors * LANES), np.float32)
    # The costs of the paths to the last two pixels of each line, infinite beyond the planes.
    paths = np.full((2, max(h, w), vectors * LANES + 2), INFINITY, np.float32)
    lows = np.empty(max(h, w), np.float32)  # least cost of each path
    numbers = np.arange(vectors * LANES).astype(np.float32)
    for n in range(start, stop):
        for y in range(h):
            for x in range(w):
                _begin(weighted[y, x], sums[y, x], costs[n, y, x], weights[n, y, x])
        for direction in range(4):
            along, back = direction % 2 == 0, direction // 2
            lines, length = (h, w) if along else (w, h)
            for line in range(lines):  # a path starts with cost 0 at all planes
                lows[line] = ZERO
                for v in range(vectors):
                    store_some(paths[0, line], 1 + v * LANES, LANES, zeros())
            for k in range(length):
                position = length - 1 - k if back else k
                entry = min(position + back, length - 1)  # position of this step's penalty
                for line in range(lines):
                    y, x = (line, position) if along else (position, line)
                    penalty = penalties[n, 0, y, entry] if along else penalties[n, 1, entry, x]
                    old, new = paths[k % 2, line], paths[(k + 1) % 2, line]
                    lows[line] = _extend(
                        old, new, lows[line], lows[line] + penalty, weighted[y, x], sums[y, x]
                    )
        for y in range(h):
            for x in range(w):
                plane[n, y, x], contrast[n, y, x] = _find_best_plane(sums[y, x], numbers, planes)


@inline
def _begin(weighted, sums, costs, weight):
    for d in range(0, len(weighted), LANES):
        count = min(len(costs) - d, LANES)
        store_some(weighted, d, LANES, INFINITY + zeros())
        store_some(weighted, d, count, load_some(costs, d, count) * weight)
        store_some(sums, d, LANES, zeros())


@inline
def _extend(old, new, low, far, cost, sums):
    """Extend the paths by a pixel: write their costs, add them to `sums`, and return the least.

    The costs before and after, `old` and `new`, have one more element at each end. `low` is the
    least of `old`, and `far` exceeds it by the penalty for a step of several planes.
    """
    lowest = INFINITY + zeros()
    for d in range(0, len(cost), LANES):
        one = min(load_some(old, d, LANES), load_some(old, d + 2, LANES)) + SMALL_STEP
        path = min(min(load_some(old, d + 1, LANES), one), far)
        path = load_some(cost, d, LANES) + (path - low)
        store_some(new, d + 1, LANES, path)
        store_some(sums, d, LANES, load_some(sums, d, LANES) + path)
        lowest = min(lowest, path)
    return least(lowest)


@inline
def _find_best_plane(costs, numbers, planes):
    """Return the plane of least cost, and the contrast; see `reference.find_best_plane`."""
    lowest, sums = INFINITY + zeros(), zeros()
    for d in range(0, planes, LANES):
        lowest = min(lowest, load_some(costs, d, LANES))
        sums = sums + load_some(costs, d, min(planes - d, LANES))
    low = least(lowest)
    first = INFINITY + zeros()
    for d in range(0, planes, LANES):
        first = min(
            first,
            where(less(low, load_some(costs, d, LANES)), INFINITY, load_some(numbers, d, LANES)),
        )
    best = np.int64(least(first))
    shift = ZERO
    if 0 < best < planes - 1:
        before, after = costs[best - 1], costs[best + 1]
        bend = before + after - 2 * costs[best]
        if bend > MIN_BEND:
            shift = min(max((before - after) / (2 * bend), -HALF), HALF)
    return best + shift, total(sums) / planes - low
