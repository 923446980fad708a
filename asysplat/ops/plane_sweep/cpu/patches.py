"""What the patches of a view have by themselves: sums along columns first, then along the row."""

import numpy as np

from asysplat.ops.plane_sweep import reference
from asysplat.ops.plane_sweep.reference import WINDOW
from asysplat.ops.simd.kernel import inline
from asysplat.ops.simd.vectors import LANES, ZERO, fma, load_some, rsqrt, store_some, zeros

AROUND = WINDOW // 2
COUNT = np.float32(WINDOW**2)  # pixels of a patch
NOISE = np.float32(reference.NOISE * WINDOW**4)  # in the variance of sums


@inline
def describe_row(offsets, scales, image, y, sums):
    """Write what turns sums over patches into correlations, for the pixels of row y.

    Args:
        offsets, scales: [W], the sum over a patch and COUNT, over the deviation of such sums.
        image: [H, W].
        sums: [2, W + WINDOW - 1], to write to: along columns, of pixels and of squares.
    """
    H, W = image.shape
    for x in range(0, W, LANES):
        count = min(W - x, LANES)
        total, square = zeros(), zeros()
        for k in range(WINDOW):
            value = load_some(image[min(max(y - AROUND + k, 0), H - 1)], x, count)
            total, square = total + value, fma(value, value, square)
        store_some(sums[0], AROUND + x, count, total)
        store_some(sums[1], AROUND + x, count, square)
    for kind in range(2):
        for k in range(AROUND):  # beyond the border its pixels go on
            sums[kind, k] = sums[kind, AROUND]
            sums[kind, AROUND + W + k] = sums[kind, AROUND + W - 1]
    for x in range(0, W, LANES):
        count = min(W - x, LANES)
        total, square = zeros(), zeros()
        for k in range(WINDOW):
            total = total + load_some(sums[0], x + k, count)
            square = square + load_some(sums[1], x + k, count)
        scale = rsqrt(variance(total, square))
        store_some(offsets, x, count, total * scale)
        store_some(scales, x, count, scale * COUNT)


@inline
def variance(total, square):
    """Return COUNT^2 variances of patches and their noise, from sums of pixels and of squares."""
    return max(fma(square, COUNT, ZERO - total * total), ZERO) + NOISE
