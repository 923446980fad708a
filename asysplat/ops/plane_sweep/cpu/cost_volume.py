"""The cost volume on CPUs: a task takes a vector of planes through a view, two rows at a time.

It warps each neighbor to the view row by row, only where the neighbor's image may contain the
points, and keeps the warped rows that two rows of patches need. It sums a patch along its columns
first, then along the row.
"""

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

from asysplat.kernels.simd.gathers import gather_squares
from asysplat.kernels.simd.threads import even_bounds, inline, kernel, run_blocks
from asysplat.kernels.simd.vectors import (
    LANES,
    ONE,
    ZERO,
    fma,
    least,
    less,
    load,
    load_some,
    rsqrt,
    store,
    store_some,
    where,
    zeros,
)
from asysplat.ops.plane_sweep import reference
from asysplat.ops.plane_sweep.reference import BEST, WINDOW, CostInputs, prepare_inputs

assert BEST == 2 and WINDOW == 5  # the kernel keeps two costs, and sums five columns
RADIUS = WINDOW // 2
COUNT = np.float32(WINDOW**2)  # pixels of a patch
NOISE = np.float32(reference.NOISE * WINDOW**4)  # COUNT^2 times the noise; see `_variance`
BUFFER = WINDOW + 1  # rows that two rows of patches need
HALF = np.float32(0.5)
FRONT = np.float32(reference.FRONT)
UNMATCHED, SECOND = np.float32(reference.UNMATCHED), np.float32(reference.SECOND)
INFINITY = np.float32(np.inf)


def cost_volume(
    images: Float[Tensor, "B V H W"],
    neighbors: Int[Tensor, "B V K"],
    projections: Float[Tensor, "B V K 3 4"],
    ranges: Float[Tensor, "B V 2"],
    planes: int,
) -> Float[Tensor, "B V H W D"]:
    """Compute the costs in float32; see `reference.cost_volume`."""
    B, V, H, W = images.shape
    inputs = prepare_inputs(images, neighbors, projections, ranges, planes)
    costs = torch.empty(B * V, H, W, planes)
    run_blocks(
        cost_planes,
        even_bounds(B * V * (inputs.inverse.shape[1] // LANES)),
        CostInputs(*(tensor.numpy() for tensor in inputs)),
        costs.numpy(),
    )
    return costs.unflatten(0, (B, V))


@kernel
def cost_planes(start, stop, inputs, costs):
    """Write the costs [n, H, W, D] of the blocks start to stop of [views, vectors of planes]."""
    H, W = inputs.images.shape[1:]
    planes = costs.shape[-1]
    K = inputs.neighbors.shape[1]
    vectors = inputs.inverse.shape[1] // LANES
    # The last rows of each neighbor: row y is at y % BUFFER.
    warped = np.empty((K, BUFFER, W, LANES), np.float32)
    visible = np.empty((K, BUFFER, W), np.uint16)
    spans = np.empty((K, H, 2), np.int64)
    # The least and the second least cost of each pixel of two rows.
    first, second = np.empty((2, W, LANES), np.float32), np.empty((2, W, LANES), np.float32)
    # What `_describe_row` computes for the patches in these rows.
    offsets, scales = np.empty((2, W), np.float32), np.empty((2, W), np.float32)
    along = np.empty((2, W + WINDOW - 1), np.float32)
    for block in range(start, stop):
        view, vector = block // vectors, block % vectors
        depth = load(inputs.inverse[view], vector)
        image = inputs.images[view]
        for k in range(K):
            if inputs.neighbors[view, k] >= 0:
                for y in range(H):
                    _find_span(spans[k, y], inputs.projections[view, k], y, depth, H, W)
        for y in range(0, H, 2):
            for row in range(2):
                _describe_row(offsets[row], scales[row], image, min(y + row, H - 1), along)
                for x in range(W):
                    store(first[row], x, zeros() + INFINITY)
                    store(second[row], x, zeros() + INFINITY)
            for k in range(K):
                if inputs.neighbors[view, k] < 0:
                    continue
                neighbor = inputs.padded[inputs.neighbors[view, k]]
                matrix = inputs.projections[view, k]
                for row in range(0 if y == 0 else y + RADIUS, min(y + RADIUS + 2, H)):
                    begin, end = W, 0  # the columns of this row that patches need
                    for near in range(max(row - RADIUS, 0), min(row + RADIUS + 1, H)):
                        begin, end = min(begin, spans[k, near, 0]), max(end, spans[k, near, 1])
                    columns = range(max(begin - RADIUS, 0), min(end + RADIUS, W))
                    slot = row % BUFFER
                    _warp_row(
                        warped[k, slot], visible[k, slot], neighbor, matrix, row, depth, columns
                    )
                patches = (image, offsets, scales)
                _compare_rows(first, second, patches, y, warped[k], visible[k], spans[k])
            for row in range(y, min(y + 2, H)):
                for x in range(W):
                    best = min(load(first[row - y], x), UNMATCHED)
                    next_best = min(load(second[row - y], x), min(best + SECOND, UNMATCHED))
                    place = ((view * H + row) * W + x) * planes + vector * LANES
                    width = min(LANES, planes - vector * LANES)
                    store_some(costs, place, width, (best + next_best) * HALF)


@inline
def _find_span(span, matrix, y, depth, H, W):
    """Write the range of the columns of row y that are inside a neighbor's image at any plane.

    The image gets a margin of one pixel, so that rounding excludes no column.
    """
    low, high = ZERO + zeros(), np.float32(W) + zeros()
    for side in range(4):
        # On the inner side, slope x column + rest > 0.
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
    crossed = less(low, high)
    low, high = where(crossed, low, np.float32(W)), where(crossed, ZERO - high, ZERO)
    span[0] = max(np.int64(least(low)) - 1, 0)
    span[1] = min(np.int64(-least(high)) + 2, W)


@inline
def _warp_row(warped, visible, neighbor, matrix, y, depth, columns):
    """Write a neighbor's pixels warped to a row, [W, LANES], and masks of those in its image."""
    bottom, right = np.float32(neighbor.shape[0] - 1), np.float32(neighbor.shape[1] - 1)
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
        visible[x] = inside & less(FRONT, z)
        u = min(max(u - HALF, ZERO), right - ONE)
        v = min(max(v - HALF, ZERO), bottom - ONE)
        a, b, c, d, v, u = gather_squares(neighbor, v, u)
        a, c = fma(b - a, u, a), fma(d - c, u, c)
        store(warped, x, fma(c - a, v, a))


@inline
def _compare_rows(first, second, patches, y, warped, visible, spans):
    """Merge a neighbor's costs into the two least of each pixel in the rows y and y + 1.

    The patches of the two rows share four rows. If y is the last row, it replaces y + 1.
    """
    image, offsets, scales = patches
    H, W = image.shape
    below = min(y + 1, H - 1)
    begin = min(spans[y, 0], spans[below, 0])
    end = max(begin, spans[y, 1], spans[below, 1])
    top, bottom = max(y - RADIUS, 0), min(y + RADIUS + 1, H - 1)
    # Sums over the last columns of the upper patches (a, b, c) and of the lower ones (d, e, f): of
    # the neighbor, of its square, and of its product with the view; see `_advance`.
    nothing = (zeros(), zeros(), zeros(), zeros())
    a, b, c, d, e, f = nothing, nothing, nothing, nothing, nothing, nothing
    for right in range(begin - RADIUS, end + RADIUS):
        column = min(max(right, 0), W - 1)  # the border is repeated beyond the image
        common = (zeros(), zeros(), zeros())
        for k in range(1, WINDOW):
            row = min(max(y - RADIUS + k, 0), H - 1)
            common = _add(common, load(warped[row % BUFFER], column), image[row, column])
        upper = _add(common, load(warped[top % BUFFER], column), image[top, column])
        lower = _add(common, load(warped[bottom % BUFFER], column), image[bottom, column])
        x = right - RADIUS
        if x >= begin:
            sums = (_sum(a, upper[0]), _sum(b, upper[1]), _sum(c, upper[2]))
            cost = where(visible[y % BUFFER, x], _cost(sums, offsets[0, x], scales[0, x]), INFINITY)
            _merge(first[0], second[0], x, cost)
            sums = (_sum(d, lower[0]), _sum(e, lower[1]), _sum(f, lower[2]))
            cost = _cost(sums, offsets[1, x], scales[1, x])
            _merge(first[1], second[1], x, where(visible[below % BUFFER, x], cost, INFINITY))
        a, b, c = _advance(a, upper[0]), _advance(b, upper[1]), _advance(c, upper[2])
        d, e, f = _advance(d, lower[0]), _advance(e, lower[1]), _advance(f, lower[2])


@inline
def _add(sums, value, pixel):
    return sums[0] + value, fma(value, value, sums[1]), fma(value, pixel, sums[2])


@inline
def _advance(last, new):
    """Return the new column, and the sums of the pairs that end 0, 1 and 2 columns before it."""
    return new, last[0] + new, last[1], last[2]


@inline
def _sum(last, new):
    """Return the sum of the new column and the four before it; for `last` see `_advance`."""
    return last[3] + last[1] + new


@inline
def _cost(sums, offset, scale):
    """Return 1 - the correlation of a patch from its `sums`; for the others see `_describe_row`."""
    total, square, both = sums
    return fma(fma(total, offset, both * -scale), rsqrt(_variance(total, square)), ONE)


@inline
def _merge(first, second, x, cost):
    before = load(first, x)
    store(second, x, min(load(second, x), max(before, cost)))
    store(first, x, min(before, cost))


@inline
def _describe_row(offsets, scales, image, y, sums):
    """Write each patch's sum, and COUNT, both divided by the root of the patch's `_variance`.

    `sums` [2, W + WINDOW - 1] is scratch memory for the sums of pixels and squares along columns.
    """
    H, W = image.shape
    for x in range(0, W, LANES):
        count = min(W - x, LANES)
        total, square = zeros(), zeros()
        for k in range(WINDOW):
            value = load_some(image[min(max(y - RADIUS + k, 0), H - 1)], x, count)
            total, square = total + value, fma(value, value, square)
        store_some(sums[0], RADIUS + x, count, total)
        store_some(sums[1], RADIUS + x, count, square)
    for kind in range(2):
        for k in range(RADIUS):  # the border is repeated beyond the image
            sums[kind, k] = sums[kind, RADIUS]
            sums[kind, RADIUS + W + k] = sums[kind, RADIUS + W - 1]
    for x in range(0, W, LANES):
        count = min(W - x, LANES)
        total, square = zeros(), zeros()
        for k in range(WINDOW):
            total = total + load_some(sums[0], x + k, count)
            square = square + load_some(sums[1], x + k, count)
        scale = rsqrt(_variance(total, square))
        store_some(offsets, x, count, total * scale)
        store_some(scales, x, count, scale * COUNT)


@inline
def _variance(total, square):
    """Return COUNT^2 times a patch's variance with noise, from its sums of pixels and squares."""
    return max(fma(square, COUNT, ZERO - total * total), ZERO) + NOISE
