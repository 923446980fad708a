"""Which tiles a splat touches, and the list of splats of every tile.

`find_spans` alone says which, from the stored splat: by it the lists are counted, and by it they
are filled.
"""

import math

import numpy as np

from asysplat.ops.cpu.kernel import inline, kernel
from asysplat.rendering.cpu import layout as col


@inline
def find_spans(splats, bases, d, size, exact, spans):
    """Set the first and last tile of each row of tiles that splat d touches.

    Args:
        size: height and width in pixels, columns in tiles.
        exact: leave out the tiles of its box that its ellipse does not touch.
        spans: [rows of tiles, 2], set from the first row to the last one.

    Returns:
        First and last row, none if last < first, and how many tiles the box touches.
    """
    height, width, _ = size
    a = float(splats[d, col.A]) + float(splats[d, col.A_REST])
    b = float(splats[d, col.B]) + float(splats[d, col.B_REST])
    c = float(splats[d, col.C])
    center_x = float(bases[d, col.BASE_X]) + float(splats[d, col.X])
    center_y = float(bases[d, col.BASE_Y]) + float(splats[d, col.Y])
    reach = float(splats[d, col.REACH_Y])
    tilt = b / c
    slope = math.sqrt(1 + tilt * tilt)
    half_width = c * reach * slope / a
    first_row, last_row = tile_range(center_y, -reach, reach, height)
    left, right = tile_range(center_x, -half_width, half_width, width)
    box = (last_row - first_row + 1) * max(right - left + 1, 0)
    has_corners = right > left and last_row > first_row
    for row in range(first_row, last_row + 1):
        spans[row, 0], spans[row, 1] = left, right
        if exact and has_corners:
            from_x, to_x = row_edges(a, b, c, reach, -tilt / slope * reach, center_y, row)
            spans[row, 0], spans[row, 1] = tile_range(center_x, from_x, to_x, width)
    return first_row, last_row, box


@inline
def row_edges(a, b, c, reach, tip, center_y, row):
    """How far left and right of its centre an ellipse reaches in a row of tiles.

    It is (a dx + b dy)^2 + (c dy)^2 <= (c reach)^2, its rightmost point at dy = tip. Between the
    row's outermost pixel centres its right edge is farthest out at its tip, or, where the tip is
    not among them, at the centre nearest to it; the left edge mirrors it.
    """
    square = (c * reach) ** 2
    low = row * col.TILE + 0.5 - col.PIXEL_MARGIN - center_y
    high = low + col.TILE - 1 + 2 * col.PIXEL_MARGIN
    low, high = max(low, -reach), min(high, reach)
    right_dy = min(max(tip, low), high)
    left_dy = min(max(-tip, low), high)
    right = (math.sqrt(max(square - (c * right_dy) ** 2, 0.0)) - b * right_dy) / a
    left = (-math.sqrt(max(square - (c * left_dy) ** 2, 0.0)) - b * left_dy) / a
    return left, right


@inline
def tile_range(center, start, stop, size):
    """First and last tile that has a pixel centre from center + start to center + stop, of an
    image of `size` pixels; the last is before the first where there is none. What is not a number
    is the image's edge."""
    first, last = center + start - 0.5 - col.PIXEL_MARGIN, center + stop - 0.5 + col.PIXEL_MARGIN
    # A number beyond int64 has no int: the edges come first.
    first = int(np.ceil(min(first, float(size)))) if first > 0 else 0
    last = int(np.floor(max(last, -1.0))) if last < size - 1 else size - 1
    return first // col.TILE, last // col.TILE if last >= first else first // col.TILE - 1


@inline
def count_tiles(splats, bases, d, size, exact, spans, histogram):
    """Add a splat's tiles to the histogram [tiles of an image]; how many, and how many its box
    touches."""
    columns = size[2]
    first_row, last_row, box = find_spans(splats, bases, d, size, exact, spans)
    count = 0
    for row in range(first_row, last_row + 1):
        for column in range(spans[row, 0], spans[row, 1] + 1):
            histogram[row * columns + column] += 1
            count += 1
    return count, box


@kernel
def place(start, stop, splats, first_pair, positions, num, block_size, size, exact, entries):
    """Write every pair (splat, its number among all pairs) of blocks start to stop into the lists.

    Args:
        first_pair: [images * N + 1] the number of a splat's first pair, and of all pairs.
        positions: [images, blocks, tiles] where a block's next pair of a tile goes.
        num, block_size: Gaussians of an image and of a block.
        size, exact: see `find_spans`.
        entries: [pairs, 2] sorted by image and tile, then by Gaussian.
    """
    bases = splats.view(np.int32)
    height, _, columns = size
    spans = np.empty((-(-height // col.TILE), 2), np.int64)
    blocks = positions.shape[1]
    for index in range(start, stop):
        image, block = index // blocks, index % blocks
        next_entry = positions[image, block]
        for n in range(block * block_size, min((block + 1) * block_size, num)):
            d = image * num + n
            pair = first_pair[d]
            if pair == first_pair[d + 1]:
                continue  # it was culled and never written
            first_row, last_row, _ = find_spans(splats, bases, d, size, exact, spans)
            for row in range(first_row, last_row + 1):
                for column in range(spans[row, 0], spans[row, 1] + 1):
                    tile = row * columns + column
                    entry = next_entry[tile]
                    next_entry[tile] = entry + 1
                    entries[entry, 0], entries[entry, 1] = d, pair
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
