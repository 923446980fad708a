"""A kernel that writes the indices by which the renderer's kernels address an image's pixels."""

import triton.language as tl

from asysplat.kernels.triton_utils import kernel
from asysplat.rendering.cuda.splat import color_pixels, tile_window


@kernel
def write_indices(out, tile, columns, tiles, height, width):
    """Write the indices in one plane, in red, green and blue, of a tile's pixels to out [4, 64]."""
    tile = tl.cast(tile, tl.int64)
    image, _, _, _, _, pixel, _ = tile_window(tile, columns, tiles, height, width)
    red, green, blue = color_pixels(pixel, image, height, width)
    lane = tl.arange(0, 64)
    tl.store(out + lane, pixel)
    tl.store(out + 64 + lane, red)
    tl.store(out + 128 + lane, green)
    tl.store(out + 192 + lane, blue)
