"""One 16-pixel row of a tile, over and over: what `rasterize` and `rasterize_backward` do with
nothing around it, which no renderer of this kind can be faster than."""

import numpy as np

from asysplat.ops.cpu.kernel import inline, kernel
from asysplat.rendering.cpu import splat as col
from asysplat.rendering.cpu.rasterize import (
    BACKWARD_STATE,
    STATE,
    aligned,
    draw_row,
    draw_row_backward,
)
from asysplat.rendering.cpu.splat import TileSplat, in_row


@inline
def tile_splat(splat, offset):
    """The splat as the tile sees it."""
    x, y = offset
    b = float(splat[col.B])
    return TileSplat(
        x=x,
        y=y,
        u=float(splat[col.A]) * x + b * y,
        b=b,
        a=splat[col.A],
        c=splat[col.C],
        log_opacity=splat[col.LOG_OPACITY],
        red=splat[col.RED],
        green=splat[col.GREEN],
        blue=splat[col.BLUE],
        z=splat[col.DEPTH],
        z_rest=splat[col.DEPTH],
    )


@kernel
def forward_rows(start, stop, splat, offset, times, settings, states):
    """Draw a splat `times` times into each of the tiles start to stop.

    Args:
        splat: [16], see `asysplat.rendering.cpu.splat`.
        offset: from its centre to the middle of the tile's first row, in pixels.
        settings: `RasterSettings`.
        states: [tiles, STATE], what the tile begins with and ends with.
    """
    seen = tile_splat(splat, offset)
    state = aligned(STATE)
    for tile in range(start, stop):
        state[:STATE] = states[tile]
        for drawn in range(times * col.TILE):
            row = in_row(seen, drawn & (col.TILE - 1))
            rank = np.float32(drawn // col.TILE)
            draw_row(state, row, rank, seen, settings, None, None)
        states[tile] = state[:STATE]


@kernel
def backward_rows(start, stop, splat, offset, times, settings, states):
    """Take the gradients of a splat `times` times in each of the tiles start to stop.

    Arguments as for `forward_rows`, but that states are [tiles, BACKWARD_STATE].
    """
    seen = tile_splat(splat, offset)
    state = aligned(BACKWARD_STATE)
    for tile in range(start, stop):
        state[:BACKWARD_STATE] = states[tile]
        for drawn in range(times * col.TILE):
            row = in_row(seen, drawn & (col.TILE - 1))
            rank = np.float32(times - 1 - drawn // col.TILE)
            draw_row_backward(state, row, rank, seen, settings, None, None)
        states[tile] = state[:BACKWARD_STATE]
