"""Splats: their columns, the frame they are drawn in, and their position relative to a tile."""

from typing import NamedTuple

import triton.language as tl

from asysplat.kernels.triton_utils import kernel
from asysplat.rendering import formulas

# A splat [16] float32: alpha = 2^(log_opacity - (a dx + b dy)^2 - (c dy)^2). Columns 0 and 1 hold
# its center, rounded down, as int32, and 2 and 3 the rest; 4 to 6 a, b, c, and 7 and 8 the rounding
# errors of a and b; 9 log_opacity; 10 the extent along y; 11 to 13 the color; 14 the depth and 15
# its rounding error.
SPLAT = tl.constexpr(16)
# The gradient of a splat in a tile [10] float32: of x, y, a, b, c, log_opacity (without a factor
# ln 2), color, depth.
GRADIENT = tl.constexpr(10)
COLUMNS = tl.constexpr(16)  # lanes for the columns of a splat's gradient: a power of two

TILE = tl.constexpr(8)  # pixels a side
HALF_TILE = tl.constexpr(4)
MAX_CENTER_OFFSET = tl.constexpr(formulas.MAX_CENTER_OFFSET)


class Frame(NamedTuple):
    """The sizes for the kernels."""

    images: int  # views of all scenes
    views: int  # views of a scene
    num: int  # Gaussians of a scene
    sh_count: int  # coefficients
    height: int  # pixels
    width: int
    columns: int  # tile columns of an image
    tiles: int  # tiles of an image

    @property
    def grid(self) -> dict[str, int]:
        """Return tiles and pixels of an image."""
        names = ("columns", "tiles", "height", "width")
        return {name: getattr(self, name) for name in names}


@kernel
def round_to_float32(value):
    """Round to float32, as float64."""
    return value.to(tl.float32).to(tl.float64)


@kernel
def floor_pixel(value):
    """Round down to a pixel, as float64."""
    return tl.minimum(tl.maximum(tl.floor(value), -MAX_CENTER_OFFSET), MAX_CENTER_OFFSET)


@kernel
def store_splat(splats, d, ellipse, log_opacity, color, z, valid):
    """Round float64 ellipses, opacities and depths, and float32 colors, to splats d."""
    x, y, a, b, c, extent_y = ellipse
    red, green, blue = color
    splat = splats + SPLAT * d
    base = splat.to(tl.pointer_type(tl.int32))
    base_x, base_y = floor_pixel(x), floor_pixel(y)
    tl.store(base, base_x.to(tl.int32), mask=valid)
    tl.store(base + 1, base_y.to(tl.int32), mask=valid)
    tl.store(splat + 2, (x - base_x).to(tl.float32), mask=valid)
    tl.store(splat + 3, (y - base_y).to(tl.float32), mask=valid)
    tl.store(splat + 4, a.to(tl.float32), mask=valid)
    tl.store(splat + 5, b.to(tl.float32), mask=valid)
    tl.store(splat + 6, c.to(tl.float32), mask=valid)
    tl.store(splat + 7, (a - round_to_float32(a)).to(tl.float32), mask=valid)
    tl.store(splat + 8, (b - round_to_float32(b)).to(tl.float32), mask=valid)
    tl.store(splat + 9, log_opacity.to(tl.float32), mask=valid)
    tl.store(splat + 10, tl.minimum(extent_y, MAX_CENTER_OFFSET).to(tl.float32), mask=valid)
    tl.store(splat + 11, red, mask=valid)
    tl.store(splat + 12, green, mask=valid)
    tl.store(splat + 13, blue, mask=valid)
    tl.store(splat + 14, z.to(tl.float32), mask=valid)
    tl.store(splat + 15, (z - round_to_float32(z)).to(tl.float32), mask=valid)


@kernel
def load_ellipse(splats, d, valid):
    """Read splats d: center, as whole pixels and rests, a, b, c, extent; ones where not `valid`."""
    splat = splats + SPLAT * d
    base = splat.to(tl.pointer_type(tl.int32))
    base_x = tl.load(base, mask=valid, other=1)
    base_y = tl.load(base + 1, mask=valid, other=1)
    x = tl.load(splat + 2, mask=valid, other=1.0)
    y = tl.load(splat + 3, mask=valid, other=1.0)
    a = tl.load(splat + 4, mask=valid, other=1.0)
    b = tl.load(splat + 5, mask=valid, other=1.0)
    c = tl.load(splat + 6, mask=valid, other=1.0)
    extent_y = tl.load(splat + 10, mask=valid, other=1.0)
    return base_x, x, base_y, y, a, b, c, extent_y


@kernel
def tile_window(tile, columns, tiles, height, width):
    """Compute the pixels of a tile; tiles are numbered image by image, row by row.

    Return its image, its first column and row; of each pixel column and row relative to the tile's
    middle, the index in images of one plane, and whether it is inside the image.
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
    """Compute the indices of pixels in the three planes of an image from those in one plane."""
    plane = tl.cast(height, tl.int64) * width
    red = pixel + 2 * image * plane
    return red, red + plane, red + 2 * plane


@kernel
def load_two(splat, k, valid):
    """Read columns k, which is even, and k + 1 of a splat, by one load; bits as int32, or 0."""
    both = tl.load((splat + k).to(tl.pointer_type(tl.int64)), mask=valid, other=0)
    return both.to(tl.int32), (both >> 32).to(tl.int32)


@kernel
def load_two_floats(splat, k, valid):
    """Read float32 columns, see `load_two`."""
    low, high = load_two(splat, k, valid)
    return low.to(tl.float32, bitcast=True), high.to(tl.float32, bitcast=True)


@kernel
def load_splat(splats, d, left, top, valid):
    """Read splat d relative to the middle of the tile whose first pixel is (left, top).

    Return x and y from its center to the middle, whole pixels and the rest of each; u = a x + b y
    there; a, b, c; log_opacity, so low where not `valid` that the splat is invisible. Far from the
    center of a needle the two terms nearly cancel: products are exact, as sums of two numbers.
    """
    splat = splats + SPLAT * d
    base_x, base_y = load_two(splat, 0, valid)
    center_x, center_y = load_two_floats(splat, 2, valid)
    a, b = load_two_floats(splat, 4, valid)
    c, rest_a = load_two_floats(splat, 6, valid)
    rest_b, log_opacity = load_two_floats(splat, 8, valid)
    log_opacity = tl.where(valid, log_opacity, -64.0)
    pixels_x, pixels_y = left + HALF_TILE - base_x, top + HALF_TILE - base_y
    x, y = pixels_x.to(tl.float32), pixels_y.to(tl.float32)
    rest_x = (pixels_x - x.to(tl.int32)).to(tl.float32) - center_x
    rest_y = (pixels_y - y.to(tl.int32)).to(tl.float32) - center_y
    ax, by = a * x, b * y
    rest = tl.fma(a, x, -ax) + tl.fma(b, y, -by)
    rest = tl.fma(a, rest_x, tl.fma(b, rest_y, rest))
    u = (ax + by) + tl.fma(rest_a, x, tl.fma(rest_b, y, rest))
    return x, rest_x, y, rest_y, u, a, b, c, log_opacity


@kernel
def load_color(splats, d, valid):
    """Read red, green, blue."""
    splat = splats + SPLAT * d
    red = tl.load(splat + 11, mask=valid, other=0.0)
    green, blue = load_two_floats(splat, 12, valid)
    return red, green, blue


@kernel
def load_depth(splats, d, valid):
    """Read a depth as a sum of two numbers."""
    return load_two_floats(splats + SPLAT * d, 14, valid)
