"""Splats: their columns, the frame they are drawn in, and how one looks from a tile."""

from typing import NamedTuple

import triton.language as tl

from asysplat.ops.triton_utils import kernel
from asysplat.rendering import formulas

# A splat [16] float32: alpha = 2^(log_opacity - (a dx + b dy)^2 - (c dy)^2), its center, rounded
# down, in columns 0 and 1 as int32, and what that leaves of it in 2 and 3; a, b, c in 4 to 6, and
# what float32 leaves of a and b in 7 and 8; log_opacity in 9; its extent along y in 10;
# color in 11 to 13; depth in 14, and what float32 leaves of it in 15.
SPLAT = tl.constexpr(16)
# Its gradient in a tile [10] float32: of x, y, a, b, c, log_opacity (these less a factor ln 2),
# color, depth.
GRADIENT = tl.constexpr(10)

TILE = tl.constexpr(8)  # pixels a side
HALF_TILE = tl.constexpr(4)
MAX_CENTER_OFFSET = tl.constexpr(formulas.MAX_CENTER_OFFSET)


class Frame(NamedTuple):
    """The sizes that the kernels are told."""

    images: int  # views of all scenes
    views: int  # of a scene
    num: int  # Gaussians of a scene
    sh_count: int  # coefficients
    height: int  # pixels
    width: int
    columns: int  # of tiles
    tiles: int  # of an image

    @property
    def grid(self) -> dict[str, int]:
        """Tiles and pixels of an image."""
        names = ("columns", "tiles", "height", "width")
        return {name: getattr(self, name) for name in names}


@kernel
def rounded(value):
    """Round to float32, as float64."""
    return value.to(tl.float32).to(tl.float64)


@kernel
def whole_pixels(value):
    """Round down, as float64."""
    return tl.minimum(tl.maximum(tl.floor(value), -MAX_CENTER_OFFSET), MAX_CENTER_OFFSET)


@kernel
def store_splat(splats, d, ellipse, log_opacity, color, z, there):
    """Round float64 ellipses, opacities and depths, and float32 colors, to splats d."""
    x, y, a, b, c, extent_y = ellipse
    red, green, blue = color
    splat = splats + SPLAT * d
    whole = splat.to(tl.pointer_type(tl.int32))
    base_x, base_y = whole_pixels(x), whole_pixels(y)
    tl.store(whole, base_x.to(tl.int32), mask=there)
    tl.store(whole + 1, base_y.to(tl.int32), mask=there)
    tl.store(splat + 2, (x - base_x).to(tl.float32), mask=there)
    tl.store(splat + 3, (y - base_y).to(tl.float32), mask=there)
    tl.store(splat + 4, a.to(tl.float32), mask=there)
    tl.store(splat + 5, b.to(tl.float32), mask=there)
    tl.store(splat + 6, c.to(tl.float32), mask=there)
    tl.store(splat + 7, (a - rounded(a)).to(tl.float32), mask=there)
    tl.store(splat + 8, (b - rounded(b)).to(tl.float32), mask=there)
    tl.store(splat + 9, log_opacity.to(tl.float32), mask=there)
    tl.store(splat + 10, tl.minimum(extent_y, MAX_CENTER_OFFSET).to(tl.float32), mask=there)
    tl.store(splat + 11, red, mask=there)
    tl.store(splat + 12, green, mask=there)
    tl.store(splat + 13, blue, mask=there)
    tl.store(splat + 14, z.to(tl.float32), mask=there)
    tl.store(splat + 15, (z - rounded(z)).to(tl.float32), mask=there)


@kernel
def load_ellipse(splats, d, there):
    """Read center, a, b, c and extent along y of splats d, in float64; ones where not `there`."""
    splat = splats + SPLAT * d
    whole = splat.to(tl.pointer_type(tl.int32))
    x = tl.load(whole, mask=there, other=0).to(tl.float64)
    y = tl.load(whole + 1, mask=there, other=0).to(tl.float64)
    x += tl.load(splat + 2, mask=there, other=1.0).to(tl.float64)
    y += tl.load(splat + 3, mask=there, other=1.0).to(tl.float64)
    a = tl.load(splat + 4, mask=there, other=1.0).to(tl.float64)
    b = tl.load(splat + 5, mask=there, other=1.0).to(tl.float64)
    c = tl.load(splat + 6, mask=there, other=1.0).to(tl.float64)
    a += tl.load(splat + 7, mask=there, other=0.0).to(tl.float64)
    b += tl.load(splat + 8, mask=there, other=0.0).to(tl.float64)
    extent_y = tl.load(splat + 10, mask=there, other=1.0).to(tl.float64)
    return x, y, a, b, c, extent_y


@kernel
def tile_window(tile, columns, tiles, height, width):
    """Return the pixels of a tile; tiles are numbered image by image, row by row.

    These are its image, its first column and row; column and row of the pixels from its middle, and
    their places in images of one plane; whether they are in the image.
    """
    lane = tl.arange(0, TILE * TILE)
    image, within = tile // tiles, tile % tiles
    left = (within % columns * TILE).to(tl.int32)
    top = (within // columns * TILE).to(tl.int32)
    column, row = lane % TILE, lane // TILE
    inside = (left + column < width) & (top + row < height)
    pixel = (image * height + top + row) * width + left + column
    middle = HALF_TILE - 0.5
    return image, left, top, column - middle, row - middle, pixel, inside


@kernel
def color_pixels(pixel, image, height, width):
    """Return where the three planes of an image have the pixels of one plane."""
    red = pixel + 2 * image * height * width
    return red, red + height * width, red + 2 * height * width


@kernel
def load_splat(splats, d, left, top, there):
    """Read splat d as it looks from the middle of the tile whose first pixel is (left, top).

    Return x and y from its center to the middle, whole pixels and the rest of each; u = a x + b y
    there; a, b, c; log_opacity, so low where not `there` that nothing shows. Far from its center a
    needle's two terms nearly cancel: products are taken exactly, as a sum of two numbers.
    """
    splat = splats + SPLAT * d
    whole = splat.to(tl.pointer_type(tl.int32))
    whole_x = left + HALF_TILE - tl.load(whole, mask=there, other=0)
    whole_y = top + HALF_TILE - tl.load(whole + 1, mask=there, other=0)
    x, y = whole_x.to(tl.float32), whole_y.to(tl.float32)
    rest_x = (whole_x - x.to(tl.int32)).to(tl.float32) - tl.load(splat + 2, mask=there, other=0.0)
    rest_y = (whole_y - y.to(tl.int32)).to(tl.float32) - tl.load(splat + 3, mask=there, other=0.0)
    a = tl.load(splat + 4, mask=there, other=0.0)
    b = tl.load(splat + 5, mask=there, other=0.0)
    c = tl.load(splat + 6, mask=there, other=0.0)
    rest_a = tl.load(splat + 7, mask=there, other=0.0)
    rest_b = tl.load(splat + 8, mask=there, other=0.0)
    log_opacity = tl.load(splat + 9, mask=there, other=-64.0)
    ax, by = a * x, b * y
    rest = tl.fma(a, x, -ax) + tl.fma(b, y, -by)
    rest = tl.fma(a, rest_x, tl.fma(b, rest_y, rest))
    u = (ax + by) + tl.fma(rest_a, x, tl.fma(rest_b, y, rest))
    return x, rest_x, y, rest_y, u, a, b, c, log_opacity


@kernel
def load_color(splats, d, there):
    """Read red, green, blue."""
    splat = splats + SPLAT * d
    red = tl.load(splat + 11, mask=there, other=0.0)
    green = tl.load(splat + 12, mask=there, other=0.0)
    blue = tl.load(splat + 13, mask=there, other=0.0)
    return red, green, blue


@kernel
def load_depth(splats, d, there):
    """Read a depth as a sum of two numbers."""
    z = tl.load(splats + SPLAT * d + 14, mask=there, other=0.0)
    return z, tl.load(splats + SPLAT * d + 15, mask=there, other=0.0)
