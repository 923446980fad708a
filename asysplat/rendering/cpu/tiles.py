"""Which splats touch which tile: counted, then placed, the same answer both times."""

import math

import numpy as np

from asysplat.ops.cpu.kernel import inline, kernel
from asysplat.rendering.cpu import layout as col


@inline
def tile_range(center, below, above, size):
    """First and last tile that has a pixel centre from center - below to center + above, of an
    image of `size` pixels; none if last < first."""
    edge = 0.5 + col.PIXEL_MARGIN
    first = int(np.ceil(max(center - below - edge, 0.0)))
    last = int(np.floor(min(center + above - 0.5 + col.PIXEL_MARGIN, size - 1.0)))
    return first // col.TILE, last // col.TILE if last >= first else -1


@inline
def tile_rows(splats, bases, d, height):
    """First and last row of tiles."""
    center = float(bases[d, col.BASE_Y]) + float(splats[d, col.Y])
    reach = float(splats[d, col.REACH_Y])
    return tile_range(center, reach, reach, height)


@inline
def tile_columns(splats, bases, d, row, width):
    """First and last tile of a row of tiles that the ellipse touches.

    It is (A dx + B dy)^2 + (C dy)^2 <= (C REACH_Y)^2. Between the row's outermost pixel centres its
    right edge is farthest out at its tip, or, where the tip is not among them, at the centre
    nearest to it; the left edge mirrors it.
    """
    a = float(splats[d, col.A])
    b = float(splats[d, col.B])
    c = float(splats[d, col.C])
    center_x = float(bases[d, col.BASE_X]) + float(splats[d, col.X])
    limit = float(splats[d, col.REACH_Y])
    square = (c * limit) ** 2
    tilt = b / c
    tip = -tilt / math.sqrt(tilt * tilt + 1) * limit  # dy of the rightmost point
    center_y = float(bases[d, col.BASE_Y]) + float(splats[d, col.Y])
    low = row * col.TILE + 0.5 - col.PIXEL_MARGIN - center_y
    high = low + col.TILE - 1 + 2 * col.PIXEL_MARGIN
    low, high = max(low, -limit), min(high, limit)
    right_dy = min(max(tip, low), high)
    left_dy = min(max(-tip, low), high)
    right = (math.sqrt(max(square - (c * right_dy) ** 2, 0.0)) - b * right_dy) / a
    left = (-math.sqrt(max(square - (c * left_dy) ** 2, 0.0)) - b * left_dy) / a
    return tile_range(center_x, -left, right, width)


@inline
def count_tiles(splats, bases, d, reach_x, size, exact, histogram, corner):
    """Add a splat's tiles to the histogram [tiles of an image]; how many, and how many its box
    touches.

    corner: set to the first tile and, where the tiles are the whole box, its width, else to 0.
    """
    height, width, columns = size
    first_row, last_row = tile_rows(splats, bases, d, height)
    center = float(bases[d, col.BASE_X]) + float(splats[d, col.X])
    left, right = tile_range(center, reach_x, reach_x, width)
    across = max(right - left + 1, 0)
    box = max(last_row - first_row + 1, 0) * across
    count = 0
    for row in range(first_row, last_row + 1):
        first, last = left, right
        if exact and across > 1 and last_row > first_row:  # else it has no corners to miss
            first, last = tile_columns(splats, bases, d, row, width)
        for column in range(first, last + 1):
            histogram[row * columns + column] += 1
            count += 1
    corner[0], corner[1] = first_row * columns + left, across if count == box else 0
    return count, box


@kernel
def place(
    start,
    stop,
    splats,
    first_pair,
    corners,
    positions,
    num,
    block_size,
    size,
    entries,
):
    """Write every pair (splat, its number among all pairs) of blocks start to stop into the lists.

    Args:
        first_pair: [images * N + 1] the number of a splat's first pair, and of all pairs.
        corners: [images * N, 2] see `count_tiles`.
        positions: [images, blocks, tiles] where a block's next pair of a tile goes.
        num, block_size: Gaussians of an image and of a block.
        size: height and width in pixels, columns in tiles.
        entries: [pairs, 2] sorted by image and tile, then by Gaussian.
    """
    bases = splats.view(np.int32)
    height, width, columns = size
    blocks = positions.shape[1]
    for index in range(start, stop):
        image, block = index // blocks, index % blocks
        for n in range(block * block_size, min((block + 1) * block_size, num)):
            d = image * num + n
            pair = first_pair[d]
            count = first_pair[d + 1] - pair
            across = corners[d, 1]
            if across > 0:
                for k in range(count):
                    tile = corners[d, 0] + k // across * columns + k % across
                    _put(entries, positions[image, block], tile, d, pair + k)
            elif count > 0:
                first_row, last_row = tile_rows(splats, bases, d, height)
                for row in range(first_row, last_row + 1):
                    first, last = tile_columns(splats, bases, d, row, width)
                    for column in range(first, last + 1):
                        _put(entries, positions[image, block], row * columns + column, d, pair)
                        pair += 1


@inline
def _put(entries, positions, tile, d, pair):
    position = positions[tile]
    positions[tile] = position + 1
    entries[position, 0] = d
    entries[position, 1] = pair


@kernel
def start_positions(start, stop, histograms, first_entry, positions):
    """Turn the counts [images, blocks, tiles] of images start to stop into first positions.

    first_entry: [images * tiles] where a tile's list begins.
    """
    blocks, tiles = histograms.shape[1:]
    for image in range(start, stop):
        for tile in range(tiles):
            position = first_entry[image * tiles + tile]
            for block in range(blocks):
                positions[image, block, tile] = position
                position += histograms[image, block, tile]
