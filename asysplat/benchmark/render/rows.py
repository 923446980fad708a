"""One 16-pixel row of a tile, over and over: what `rasterize` and `rasterize_backward` do with
nothing around it, which no renderer of this kind can be faster than."""

import numpy as np

from asysplat.ops.cpu.kernel import inline, kernel
from asysplat.ops.cpu.lanes import LANES
from asysplat.rendering.cpu import backward, forward
from asysplat.rendering.cpu import layout as col
from asysplat.rendering.cpu.backward import draw_row_backward
from asysplat.rendering.cpu.forward import draw_row
from asysplat.rendering.cpu.tile import PLANE, aligned, row_of

FORWARD_STATE = forward.PLANES * PLANE
BACKWARD_STATE = backward.PLANES * PLANE + backward.SUMS * LANES


@inline
def row_again(splat, offset, drawn):
    """`row_of` of the rows of a tile in turn."""
    x, y = offset
    b = float(splat[col.B])
    u0 = float(splat[col.A]) * x + b * y
    return row_of(drawn & (col.TILE - 1), y, u0, b, splat[col.C], splat[col.LOG_OPACITY])


@kernel
def forward_rows(start, stop, splat, offset, times, convention, states):
    """Draw a splat `times` times into each of the tiles start to stop.

    Args:
        splat: [16], see `layout`.
        offset: from its centre to the middle of the tile's first row, in pixels.
        convention: alpha_min, alpha_max, transmittance_min, float32.
        states: [tiles, FORWARD_STATE], what the tile begins with and ends with.
    """
    a, color = splat[col.A], (splat[col.RED], splat[col.GREEN], splat[col.BLUE])
    z = splat[col.DEPTH]
    state = aligned(FORWARD_STATE)
    for tile in range(start, stop):
        state[:FORWARD_STATE] = states[tile]
        for drawn in range(times * col.TILE):
            base, _, exponent, middle = row_again(splat, offset, drawn)
            rank = np.float32(drawn // col.TILE)
            draw_row(state, base, rank, a, middle, exponent, color, z, z, convention, None, None)
        states[tile] = state[:FORWARD_STATE]


@kernel
def backward_rows(start, stop, splat, offset, times, convention, states):
    """Take the gradients of a splat `times` times in each of the tiles start to stop.

    Arguments as for `forward_rows`, but that states are [tiles, BACKWARD_STATE].
    """
    a, color = splat[col.A], (splat[col.RED], splat[col.GREEN], splat[col.BLUE])
    z = splat[col.DEPTH]
    state = aligned(BACKWARD_STATE)
    for tile in range(start, stop):
        state[:BACKWARD_STATE] = states[tile]
        for drawn in range(times * col.TILE):
            base, dy, exponent, middle = row_again(splat, offset, drawn)
            rank = np.float32(times - 1 - drawn // col.TILE)
            draw_row_backward(
                state, base, rank, dy, a, middle, exponent, color, z, z, convention, None, None
            )
        states[tile] = state[:BACKWARD_STATE]
