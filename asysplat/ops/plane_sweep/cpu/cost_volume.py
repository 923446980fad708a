"""The costs: a task takes a vector of planes through a view, two rows at a time.

Of each neighbor it warps one row after the other, where the neighbor may see something, and keeps
as many as two rows of patches have; the sums over patches are taken along columns first, then along
the row.
"""

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

from asysplat.ops.plane_sweep import reference
from asysplat.ops.plane_sweep.cpu.patches import AROUND, describe_row, variance
from asysplat.ops.plane_sweep.inputs import CostInputs, prepare
from asysplat.ops.plane_sweep.reference import BEST, WINDOW
from asysplat.ops.simd.gathers import gather_squares
from asysplat.ops.simd.kernel import inline, kernel
from asysplat.ops.simd.threads import even_bounds, run_blocks
from asysplat.ops.simd.vectors import (
    LANES,
    ONE,
    ZERO,
    fma,
    least,
    less,
    load,
    rsqrt,
    store,
    store_some,
    where,
    zeros,
)

assert BEST == 2 and WINDOW == 5  # the least cost and the one after; sums of five columns
KEPT = WINDOW + 1  # rows that two rows of patches take
HALF = np.float32(0.5)
FRONT = np.float32(reference.FRONT)
UNSEEN = np.float32(reference.UNSEEN)
INFINITY = np.float32(np.inf)


def cost_volume(
    images: Float[Tensor, "B V H W"],
    neighbors: Int[Tensor, "B V K"],
    projections: Float[Tensor, "B V K 3 4"],
    ranges: Float[Tensor, "B V 2"],
    planes: int,
    stride: int,
) -> Float[Tensor, "B V h w D"]:
    """Compute the costs in float32; see `reference.cost_volume`."""
    B, V, H, W = images.shape
    inputs = prepare(images, neighbors, projections, ranges, planes)
    costs = torch.empty(B * V, H // stride, W // stride, planes)
    run_blocks(
        cost_planes,
        even_bounds(B * V * (inputs.inverse.shape[1] // LANES)),
        CostInputs(*(tensor.numpy() for tensor in inputs)),
        stride,
        costs.numpy(),
    )
    return costs.unflatten(0, (B, V))


@kernel
def cost_planes(start, stop, inputs, stride, costs):
    """Write the costs of the blocks start to stop, counted over [views, vectors of planes].

    Args:
        inputs: see `CostInputs`.
        costs: [n, h, w, D].
    """
    H, W = inputs.images.shape[1:]
    h, w, planes = costs.shape[1:]
    K = inputs.neighbors.shape[1]
    vectors = inputs.inverse.shape[1] // LANES
    share = np.float32(0.5 / (stride * stride))
    # A place for each of the last rows of each neighbor.
    warped = np.empty((K, KEPT, W, LANES), np.float32)
    seen = np.empty((K, KEPT, W), np.uint16)
    spans = np.empty((K, H, 2), np.int64)
    # The least cost of each pixel of two rows, and the one after.
    first, second = np.empty((2, W, LANES), np.float32), np.empty((2, W, LANES), np.float32)
    # Of the patches of these rows.
    offsets, scales = np.empty((2, W), np.float32), np.empty((2, W), np.float32)
    along = np.empty((2, W + WINDOW - 1), np.float32)
    sums = np.empty((w, LANES), np.float32)
    for block in range(start, stop):
        view, vector = block // vectors, block % vectors
        depth = load(inputs.inverse[view], vector)
        image = inputs.images[view]
        number = 0
        for k in range(K):
            if inputs.neighbors[view, k] >= 0:
                number += 1
                for y in range(H):
                    _find_span(spans[k, y], inputs.projections[view, k], y, depth, H, W)
        for y in range(0, H, 2):
            # What fewer neighbors than two leave open is unseen.
            for row in range(2):
                describe_row(offsets[row], scales[row], image, min(y + row, H - 1), along)
                for x in range(W):
                    store(first[row], x, zeros() + (UNSEEN if number < 2 else INFINITY))
                    store(second[row], x, zeros() + (UNSEEN if number < 1 else INFINITY))
            for k in range(K):
                if inputs.neighbors[view, k] < 0:
                    continue
                other = inputs.padded[inputs.neighbors[view, k]]
                matrix = inputs.projections[view, k]
                for row in range(0 if y == 0 else y + AROUND, min(y + AROUND + 2, H)):
                    begin, end = W, 0  # of what patches take from this row
                    for near in range(max(row - AROUND, 0), min(row + AROUND + 1, H)):
                        begin, end = min(begin, spans[k, near, 0]), max(end, spans[k, near, 1])
                    columns = range(max(begin - AROUND, 0), min(end + AROUND, W))
                    place = row % KEPT
                    _warp_row(warped[k, place], seen[k, place], other, matrix, row, depth, columns)
                patches = (image, offsets, scales)
                _compare_rows(first, second, patches, y, warped[k], seen[k], spans[k])
            for row in range(y, min(y + 2, H)):
                if row % stride == 0:
                    sums[:] = ZERO
                for i in range(w):
                    both = load(sums, i)
                    for x in range(i * stride, (i + 1) * stride):
                        both = both + (load(first[row - y], x) + load(second[row - y], x))
                    store(sums, i, both)
                if row % stride == stride - 1:
                    for i in range(w):
                        place = ((view * h + row // stride) * w + i) * planes + vector * LANES
                        width = min(LANES, planes - vector * LANES)
                        store_some(costs, place, width, load(sums, i) * share)


@inline
def _find_span(span, matrix, y, depth, H, W):
    """Write the first column of row y that a neighbor sees at some plane, and one past the last.

    A pixel around its image counts as within, so that rounding leaves none out.
    """
    low, high = ZERO + zeros(), np.float32(W) + zeros()
    for side in range(4):
        # What is on the inner side has slope x column + rest > 0.
        axis, sign = side // 2, ONE - np.float32(2 * (side % 2))
        shift = ONE if side % 2 == 0 else np.float32(1 + (W if axis == 0 else H))
        slope = sign * matrix[axis, 0] + shift * matrix[2, 0]
        flat = sign * matrix[axis, 1] + shift * matrix[2, 1]
        flat = fma(flat, np.float32(y) + HALF, sign * matrix[axis, 2] + shift * matrix[2, 2])
        rest = fma(depth, sign * matrix[axis, 3] + shift * matrix[2, 3], flat)
        if slope > ZERO:
            low = max(rest / -slope, low)
        elif slope < ZERO:
            high = min(rest / -slope, high)
        else:
            high = where(less(ZERO, rest), high, ZERO)
    some = less(low, high)
    low, high = where(some, low, np.float32(W)), where(some, ZERO - high, ZERO)
    span[0] = max(np.int64(least(low)) - 1, 0)
    span[1] = min(np.int64(-least(high)) + 2, W)


@inline
def _warp_row(warped, seen, other, matrix, y, depth, columns):
    """Write what a neighbor shows at pixels of a row, [W, LANES] and whether it sees them."""
    bottom, right = np.float32(other.shape[0] - 1), np.float32(other.shape[1] - 1)
    row = np.float32(y) + HALF
    x_row = fma(depth, matrix[0, 3], fma(matrix[0, 1], row, matrix[0, 2]))
    y_row = fma(depth, matrix[1, 3], fma(matrix[1, 1], row, matrix[1, 2]))
    z_row = fma(depth, matrix[2, 3], fma(matrix[2, 1], row, matrix[2, 2]))
    for x in columns:
        column = np.float32(x) + HALF + zeros()
        z = fma(column, matrix[2, 0], z_row)
        scale = ONE / max(z, FRONT)
        u = fma(column, matrix[0, 0], x_row) * scale
        v = fma(column, matrix[1, 0], y_row) * scale
        inside = less(ZERO, u) & less(u, right) & less(ZERO, v) & less(v, bottom)
        seen[x] = inside & less(FRONT, z)
        u = min(max(u - HALF, ZERO), right - ONE)
        v = min(max(v - HALF, ZERO), bottom - ONE)
        a, b, c, d, v, u = gather_squares(other, v, u)
        a, c = fma(b - a, u, a), fma(d - c, u, c)
        store(warped, x, fma(c - a, v, a))


@inline
def _compare_rows(first, second, patches, y, warped, seen, spans):
    """Put the costs of a neighbor among the two least of each pixel of the rows y and y + 1.

    Both rows' patches have four rows in common. Past the last row, y stands in for y + 1.
    """
    image, offsets, scales = patches
    H, W = image.shape
    below = min(y + 1, H - 1)
    begin = min(spans[y, 0], spans[below, 0])
    end = max(begin, spans[y, 1], spans[below, 1])
    for row in range(2):
        for x in range(begin):
            _put(first[row], second[row], x, UNSEEN + zeros())
        for x in range(end, W):
            _put(first[row], second[row], x, UNSEEN + zeros())
    top, bottom = max(y - AROUND, 0), min(y + AROUND + 1, H - 1)
    # The sums along the last columns: of the neighbor, its square, its product with the view.
    nothing = (zeros(), zeros(), zeros(), zeros())
    a, b, c, d, e, f = nothing, nothing, nothing, nothing, nothing, nothing
    for right in range(begin - AROUND, end + AROUND):
        column = min(max(right, 0), W - 1)  # beyond the border its pixels go on
        common = (zeros(), zeros(), zeros())
        for k in range(1, WINDOW):
            row = min(max(y - AROUND + k, 0), H - 1)
            common = _add(common, load(warped[row % KEPT], column), image[row, column])
        upper = _add(common, load(warped[top % KEPT], column), image[top, column])
        lower = _add(common, load(warped[bottom % KEPT], column), image[bottom, column])
        x = right - AROUND
        if x >= begin:
            sums = (_sum(a, upper[0]), _sum(b, upper[1]), _sum(c, upper[2]))
            cost = where(seen[y % KEPT, x], _cost(sums, offsets[0, x], scales[0, x]), UNSEEN)
            _put(first[0], second[0], x, cost)
            sums = (_sum(d, lower[0]), _sum(e, lower[1]), _sum(f, lower[2]))
            cost = _cost(sums, offsets[1, x], scales[1, x])
            _put(first[1], second[1], x, where(seen[below % KEPT, x], cost, UNSEEN))
        a, b, c = _go_on(a, upper[0]), _go_on(b, upper[1]), _go_on(c, upper[2])
        d, e, f = _go_on(d, lower[0]), _go_on(e, lower[1]), _go_on(f, lower[2])


@inline
def _add(sums, value, pixel):
    """Add a neighbor's values to the three sums."""
    return sums[0] + value, fma(value, value, sums[1]), fma(value, pixel, sums[2])


@inline
def _go_on(last, new):
    """Return the last column, and the sums of the last two, of the two that end before, ..."""
    return new, last[0] + new, last[1], last[2]


@inline
def _sum(last, new):
    """Return the sum of five columns."""
    return last[3] + last[1] + new


@inline
def _cost(sums, offset, scale):
    """Return 1 - the correlation, from the sums over a patch; see `describe_row`."""
    total, square, both = sums
    return fma(fma(total, offset, both * -scale), rsqrt(variance(total, square)), ONE)


@inline
def _put(first, second, x, cost):
    """Put a cost among the two least of a pixel."""
    before = load(first, x)
    store(second, x, min(load(second, x), max(before, cost)))
    store(first, x, min(before, cost))
