"""How both passes see the pixels of a tile."""

import triton.language as tl

from asysplat.ops.cuda.kernel import kernel

TILE = tl.constexpr(8)  # pixels a side
HALF_TILE = tl.constexpr(4)


@kernel
def tile_pixels(tile, columns, tiles, height, width):
    """Image, first column, first row of a tile; column and row of its pixels from its middle, and
    their places in images of one plane; whether they are in the image."""
    lane = tl.arange(0, TILE * TILE)
    picture, within = tile // tiles, tile % tiles
    left = (within % columns * TILE).to(tl.int32)
    top = (within // columns * TILE).to(tl.int32)
    column, row = lane % TILE, lane // TILE
    inside = (left + column < width) & (top + row < height)
    pixel = (picture * height + top + row) * width + left + column
    middle = HALF_TILE - 0.5
    return picture, left, top, column - middle, row - middle, pixel, inside


@kernel
def color_pixels(pixel, picture, height, width):
    """Where the three planes of an image have pixels of one plane."""
    red = pixel + 2 * picture * height * width
    return red, red + height * width, red + 2 * height * width


@kernel
def alpha_at(u, v, log_opacity, alpha_min, alpha_max):
    """Alpha of a splat, 0 below alpha_min."""
    alpha = tl.exp2(tl.fma(-u, u, tl.fma(-v, v, log_opacity)))
    alpha = tl.minimum(alpha, alpha_max)
    return tl.where(alpha >= alpha_min, alpha, 0.0)
