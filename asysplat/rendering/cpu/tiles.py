"""Which splats touch which tile: counted, then placed, the same answer both times."""

import math

import numpy as np

from asysplat.rendering.cpu import layout as col
from asysplat.rendering.cpu.kernel import inline, kernel


@inline
def clipped_range(low, high, size):
    """Pixels whose centres lie from `low` to `high`, of 0 to size - 1; empty if last < first."""
    first = math.ceil(max(low - 0.5 - col.PIXEL_MARGIN, -1.0))
    last = math.floor(min(high - 0.5 + col.PIXEL_MARGIN, size + 1.0))
    return max(int(first), 0), min(int(last), size - 1)


@inline
def tile_rows(splats, bases, d, height):
    """First and last row of tiles."""
    center = float(bases[d, col.BASE_Y]) + float(splats[d, col.Y])
    reach = float(splats[d, col.REACH_Y])
    first, last = clipped_range(center - reach, center + reach, height)
    return first // col.TILE, last // col.TILE if last >= first else -1


@inline
def tile_columns(splats, bases, d, row, width, exact):
    """First and last tile of a row of tiles: those the ellipse touches, or, if not `exact`, those
    its box does.

    The ellipse is (A dx + B dy)^2 + (C dy)^2 <= (C REACH_Y)^2. Between the row's outermost pixel
    centres its right edge is farthest out at its tip, or, where the tip is not among them, at the
    centre nearest to it; the left edge mirrors it.
    """
    a = float(splats[d, col.A])
    b = float(splats[d, col.B])
    c = float(splats[d, col.C])
    center_x = float(bases[d, col.BASE_X]) + float(splats[d, col.X])
    limit = float(splats[d, col.REACH_Y])
    square = (c * limit) ** 2
    tilt = b / c
    tip = -tilt / math.sqrt(tilt * tilt + 1) * limit  # dy of the rightmost point
    if exact:
        center_y = float(bases[d, col.BASE_Y]) + float(splats[d, col.Y])
        low = row * col.TILE + 0.5 - col.PIXEL_MARGIN - center_y
        high = low + col.TILE - 1 + 2 * col.PIXEL_MARGIN
        low, high = max(low, -limit), min(high, limit)
    else:
        low, high = -limit, limit
    right_dy = min(max(tip, low), high)
    left_dy = min(max(-tip, low), high)
    right = (math.sqrt(max(square - (c * right_dy) ** 2, 0.0)) - b * right_dy) / a
    left = (-math.sqrt(max(square - (c * left_dy) ** 2, 0.0)) - b * left_dy) / a
    first, last = clipped_range(center_x + left, center_x + right, width)
    return first // col.TILE, last // col.TILE if last >= first else -1


@inline
def count_tiles(splats, bases, d, size, exact, histogram):
    """Add a splat's tiles to the histogram [tiles of an image]; how many, the first of them, and
    how many its box touches."""
    height, width, columns = size
    first_row, last_row = tile_rows(splats, bases, d, height)
    left, right = tile_columns(splats, bases, d, first_row, width, False)
    box = (last_row - first_row + 1) * (right - left + 1)
    count, first_tile = 0, -1
    for row in range(first_row, last_row + 1):
        first, last = left, right
        if exact and box > 1:
            first, last = tile_columns(splats, bases, d, row, width, True)
        for column in range(first, last + 1):
            tile = row * columns + column
            histogram[tile] += 1
            count += 1
            if first_tile < 0:
                first_tile = tile
    return count, first_tile, box


@kernel
def place(
    start,
    stop,
    splats,
    first_pair,
    first_tiles,
    positions,
    num,
    block_size,
    size,
    exact,
    entries,
):
    """Write every pair (splat, its number among all pairs) of blocks start to stop into the lists.

    Args:
        first_pair: [images * N + 1] the number of a splat's first pair, and of all pairs.
        first_tiles: [images * N] a splat's first tile.
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
            if count == 0:
                continue
            if count == 1:  # most of them, and known
                tile = first_tiles[d]
                position = positions[image, block, tile]
                positions[image, block, tile] = position + 1
                entries[position, 0] = d
                entries[position, 1] = pair
                continue
            first_row, last_row = tile_rows(splats, bases, d, height)
            for row in range(first_row, last_row + 1):
                first, last = tile_columns(splats, bases, d, row, width, exact)
                for column in range(first, last + 1):
                    tile = row * columns + column
                    position = positions[image, block, tile]
                    positions[image, block, tile] = position + 1
                    entries[position, 0] = d
                    entries[position, 1] = pair
                    pair += 1


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
