"""How both passes see a splat from a tile."""

import math

import numpy as np

from asysplat.ops.cpu.kernel import inline
from asysplat.ops.cpu.lanes import HALF, LANES, MIDDLE, fma, to_bits
from asysplat.rendering.cpu import layout as col

PIXELS = col.TILE * LANES
# From one plane of a tile's state to the next: planes 4096 bytes apart would look like one to the
# processor's store buffer.
PLANE = PIXELS + LANES
AHEAD = 4  # splats that are fetched from memory before they are drawn
CHECK = 15  # look after every 16 splats whether a row is opaque


@inline
def aligned(count):
    """float32 scratch at a cache line's beginning, so that no vector straddles two."""
    memory = np.empty(count + 16, np.float32)
    return memory[((-memory.ctypes.data) & 63) // 4 :]


@inline
def corner(tile, grid):
    """Image, first pixel column and row, and number of rows and columns of a tile."""
    columns, tiles, height, width = grid
    left = tile % tiles % columns * col.TILE
    top = tile % tiles // columns * col.TILE
    return tile // tiles, left, top, min(col.TILE, height - top), min(col.TILE, width - left)


@inline
def center_offset(splats, bases, d, left, top):
    """From a splat's centre to the middle of the tile's first row, float64."""
    x = left + float(MIDDLE + HALF) - float(bases[d, col.BASE_X]) - float(splats[d, col.X])
    y = top + float(HALF) - float(bases[d, col.BASE_Y]) - float(splats[d, col.Y])
    return x, y


@inline
def rows_in_reach(splats, d, y, rows):
    """First and last row of the tile that the splat can show in."""
    reach = float(splats[d, col.REACH_Y]) + col.PIXEL_MARGIN
    first = math.ceil(max(-y - reach, 0.0))
    last = math.floor(min(-y + reach, rows - 1.0))
    return first, last


@inline
def whitened_start(splats, d, x, y):
    """u = A dx + B dy in the middle of the first row and what a row adds, float64: far from its
    centre a needle's two terms nearly cancel."""
    a = float(splats[d, col.A]) + float(splats[d, col.A_REST])
    b = float(splats[d, col.B]) + float(splats[d, col.B_REST])
    return a * x + b * y, b


@inline
def row_of(row, y, u0, b, c, log_opacity):
    """Where the tile's row begins in a plane, how far below the splat's centre it is, the exponent
    where u is 0, and u in the middle."""
    dy = np.float32(y + row)
    v = c * dy
    base = (row & (col.TILE - 1)) * LANES
    return base, dy, fma(-v, v, log_opacity), np.float32(u0 + b * row)


@inline
def is_opaque(left_over, base):
    """Whether nothing behind can show in this row."""
    any_left = np.int32(0)
    for i in range(LANES):
        any_left |= to_bits(left_over[base + i])
    return any_left == 0
