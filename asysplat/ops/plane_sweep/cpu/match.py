"""The costs: a task takes a vector of planes through a view, row by row.

Of each neighbour it warps one row after the other, and keeps as many as a patch has; the sums over
patches are taken along columns first, then along the row.
"""

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

from asysplat.ops.cpu.kernel import inline, kernel
from asysplat.ops.cpu.threads import even_bounds, run_blocks
from asysplat.ops.cpu.vectors import (
    LANES,
    ONE,
    ZERO,
    floor,
    fma,
    gather_pairs,
    load,
    positive,
    sqrt,
    store,
    store_some,
    where,
    zeros,
)
from asysplat.ops.plane_sweep import reference
from asysplat.ops.plane_sweep.cameras import FRONT as LEAST_FRONT
from asysplat.ops.plane_sweep.inputs import MatchInputs, prepare
from asysplat.ops.plane_sweep.reference import BEST, WINDOW

assert BEST == 2  # the kernel keeps the least cost and the one after
AROUND = WINDOW // 2
HALF = np.float32(0.5)
FRONT = np.float32(LEAST_FRONT)
UNSEEN, NOISE = np.float32(reference.UNSEEN), np.float32(reference.NOISE)
INFINITY = np.float32(np.inf)
SHARE = np.float32(1 / WINDOW**2)  # of a pixel in a patch


def match(
    images: Float[Tensor, "B V H W"],
    neighbours: Int[Tensor, "B V K"],
    projections: Float[Tensor, "B V K 3 4"],
    ranges: Float[Tensor, "B V 2"],
    planes: int,
    stride: int,
) -> Float[Tensor, "B V h w D"]:
    """Compute the costs in float32; see `reference.match`."""
    B, V, H, W = images.shape
    inputs = prepare(images, neighbours, projections, ranges, planes)
    costs = torch.empty(B * V, H // stride, W // stride, planes)
    run_blocks(
        match_planes,
        even_bounds(B * V * (inputs.inverse.shape[1] // LANES)),
        MatchInputs(*(tensor.numpy() for tensor in inputs)),
        stride,
        costs.numpy(),
    )
    return costs.unflatten(0, (B, V))


@kernel
def match_planes(start, stop, inputs, stride, costs):
    """Write the costs of the blocks start to stop, counted over [views, vectors of planes].

    Args:
        inputs: see `MatchInputs`.
        costs: [n, h, w, D].
    """
    H, W = inputs.images.shape[1:]
    h, w, planes = costs.shape[1:]
    K = inputs.neighbours.shape[1]
    vectors = inputs.inverse.shape[1] // LANES
    share = np.float32(0.5 / (stride * stride))
    # A place for each of the last rows of each neighbour.
    warped = np.empty((K, WINDOW, W, LANES), np.float32)
    seen = np.empty((K, WINDOW, W), np.uint16)
    first, second = np.empty((W, LANES), np.float32), np.empty((W, LANES), np.float32)
    sums = np.empty((w, LANES), np.float32)
    for block in range(start, stop):
        view, vector = block // vectors, block % vectors
        inverse = inputs.inverse[view].reshape(vectors, LANES)
        number = 0
        for k in range(K):
            number += inputs.neighbours[view, k] >= 0
        for y in range(H):
            if y % stride == 0:
                sums[:] = ZERO
            # What fewer neighbours than two leave open is unseen.
            first[:] = UNSEEN if number < 2 else INFINITY
            second[:] = UNSEEN if number < 1 else INFINITY
            for k in range(K):
                if inputs.neighbours[view, k] < 0:
                    continue
                other = inputs.padded[inputs.neighbours[view, k]]
                matrix = inputs.projections[view, k]
                for row in range(0 if y == 0 else y + AROUND, min(y + AROUND + 1, H)):
                    place = row % WINDOW
                    _warp_row(warped[k, place], seen[k, place], other, matrix, row, inverse, vector)
                _compare_row(first, second, inputs, view, y, warped[k], seen[k, y % WINDOW])
            for x in range(W):
                i = x // stride
                store(sums, i, load(sums, i) + (load(first, x) + load(second, x)))
            if y % stride == stride - 1:
                for i in range(w):
                    place = ((view * h + y // stride) * w + i) * planes + vector * LANES
                    width = min(LANES, planes - vector * LANES)
                    store_some(costs, place, width, load(sums, i) * share)


@inline
def _warp_row(warped, seen, other, matrix, y, inverse, vector):
    """Write what a neighbour shows at the pixels of a row, [W, LANES] and whether it sees them."""
    W = len(warped)
    depth = load(inverse, vector)
    bottom, right = np.float32(other.shape[0] - 1), np.float32(other.shape[1] - 1)
    row = np.float32(y) + HALF
    x_row = fma(matrix[0, 1], row, matrix[0, 2])
    y_row = fma(matrix[1, 1], row, matrix[1, 2])
    z_row = fma(matrix[2, 1], row, matrix[2, 2])
    for x in range(W):
        column = np.float32(x) + HALF
        z = fma(depth, matrix[2, 3], fma(matrix[2, 0], column, z_row))
        scale = ONE / max(z, FRONT)
        u = fma(depth, matrix[0, 3], fma(matrix[0, 0], column, x_row)) * scale
        v = fma(depth, matrix[1, 3], fma(matrix[1, 0], column, y_row)) * scale
        inside = min(min(u, right - u), min(v, bottom - v))
        seen[x] = positive(min(inside, z - FRONT))
        u = min(max(u - HALF, ZERO), right - ONE)
        v = min(max(v - HALF, ZERO), bottom - ONE)
        left, top = floor(u), floor(v)
        a, b = gather_pairs(other, top, left)
        c, d = gather_pairs(other, top + ONE, left)
        u, v = u - left, v - top
        a, c = fma(b - a, u, a), fma(d - c, u, c)
        store(warped, x, fma(c - a, v, a))


@inline
def _compare_row(first, second, inputs, view, y, warped, seen):
    """Put the costs of a neighbour among the two least of each pixel of row y."""
    H, W = inputs.images.shape[1:]
    image, means, scales = inputs.images[view], inputs.means[view, y], inputs.scales[view, y]
    # The sums along the last columns of the neighbour, its square, and its product with the view.
    a1, a2, a3, a4 = zeros(), zeros(), zeros(), zeros()
    b1, b2, b3, b4 = zeros(), zeros(), zeros(), zeros()
    c1, c2, c3, c4 = zeros(), zeros(), zeros(), zeros()
    for right in range(-AROUND, W + AROUND):
        column = min(max(right, 0), W - 1)  # beyond the border its pixels go on
        a, b, c = zeros(), zeros(), zeros()
        for k in range(WINDOW):
            row = min(max(y - AROUND + k, 0), H - 1)
            value = load(warped[row % WINDOW], column)
            a = a + value
            b = fma(value, value, b)
            c = fma(image[row, column], value, c)
        x = right - AROUND
        if x >= 0:
            mean = (a1 + a2 + (a3 + a4 + a)) * SHARE
            square = (b1 + b2 + (b3 + b4 + b)) * SHARE
            both = (c1 + c2 + (c3 + c4 + c)) * SHARE - means[x] * mean
            variance = max(square - mean * mean, ZERO) + NOISE
            cost = where(seen[x], ONE - both * scales[x] / sqrt(variance), UNSEEN)
            least = load(first, x)
            store(second, x, min(load(second, x), max(least, cost)))
            store(first, x, min(least, cost))
        a1, a2, a3, a4 = a2, a3, a4, a
        b1, b2, b3, b4 = b2, b3, b4, b
        c1, c2, c3, c4 = c2, c3, c4, c
