"""How every function here is compiled, and what both passes share.

Products and sums that decide what a pixel shows are fused by name and never by the compiler's
choice, so that the forward and the backward pass take identical decisions.
"""

import inspect
from collections.abc import Callable

import triton
import triton.language as tl


def kernel(function: Callable) -> Callable:
    """Compiled without what a type checker has put around it."""
    return triton.jit(inspect.unwrap(function))


@kernel
def tile_pixels(tile, columns, tiles, height, width, TILE: tl.constexpr):
    """Image, column, row, and whether it is in the image, of the pixels of a tile."""
    lane = tl.arange(0, TILE * TILE)
    within = tile % tiles
    column = within % columns * TILE + lane % TILE
    row = within // columns * TILE + lane // TILE
    return tile // tiles, column, row, (column < width) & (row < height)


@kernel
def offset(plane, row, column, height, width):
    """Of pixels in planes of height x width; in int64, as `plane` is."""
    return (plane * height + row) * width + column


@kernel
def load_shape(splat, there):
    """x, y, a, b, c, opacity of a splat; all 0, and so its alpha, if it is not there."""
    x = tl.load(splat, mask=there, other=0.0)
    y = tl.load(splat + 1, mask=there, other=0.0)
    a = tl.load(splat + 2, mask=there, other=0.0)
    b = tl.load(splat + 3, mask=there, other=0.0)
    c = tl.load(splat + 4, mask=there, other=0.0)
    opacity = tl.load(splat + 5, mask=there, other=0.0)
    return x, y, a, b, c, opacity


@kernel
def load_color(splat, there):
    """Red, green, blue of a splat."""
    red = tl.load(splat + 6, mask=there, other=0.0)
    green = tl.load(splat + 7, mask=there, other=0.0)
    blue = tl.load(splat + 8, mask=there, other=0.0)
    return red, green, blue


@kernel
def alpha_at(dx, dy, a, b, c, opacity, before, alpha_min, alpha_max, transmittance_min):
    """A splat at pixels (dx, dy) from its centre, behind which `before` is the transmittance.

    Its alpha, 0 where alpha_min or the stop drops it; the transmittance behind it; u and v, the
    exponent being -u^2 - v^2.
    """
    u = tl.fma(a, dx, b * dy)
    v = c * dy
    alpha = tl.minimum(opacity * tl.exp2(-tl.fma(u, u, v * v)), alpha_max)
    alpha = tl.where(alpha >= alpha_min, alpha, 0.0)
    # It never grows, so dropping below the limit drops everything behind as well.
    after = before * (1 - alpha)
    return tl.where(after >= transmittance_min, alpha, 0.0), after, u, v
