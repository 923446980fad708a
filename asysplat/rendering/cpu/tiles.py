"""Which tiles a splat touches, and the list of splats of every tile.

Which tiles is asked once, while the splat is in the cache: what is found is kept, and the lists are
made of that.
"""

import math

import numpy as np

from asysplat.ops.cpu.kernel import inline, kernel
from asysplat.rendering.cpu import layout as col


@inline
def tile_range(center, start, stop, size):
    """First and last tile that has a pixel centre from center + start to center + stop, of an
    image of `size` pixels; the last is before the first where there is none. What is not a number
    is the image's edge."""
    first, last = center + start - 0.5 - col.PIXEL_MARGIN, center + stop - 0.5 + col.PIXEL_MARGIN
    # Limited as a float: a number beyond int64 has no int.
    first = int(np.ceil(min(first, float(size)))) if first > 0 else 0
    last = int(np.floor(max(last, -1.0))) if last < size - 1 else size - 1
    return first // col.TILE, last // col.TILE if last >= first else first // col.TILE - 1


@inline
def find_box(splats, bases, d, reach_x, size, box):
    """Set the first and last row, the first and last column of tiles that the box of splat d
    touches; how many they are."""
    height, width, _ = size
    center_x = float(bases[d, col.BASE_X]) + float(splats[d, col.X])
    center_y = float(bases[d, col.BASE_Y]) + float(splats[d, col.Y])
    reach_y = float(splats[d, col.REACH_Y])
    box[0], box[1] = tile_range(center_y, -reach_y, reach_y, height)
    box[2], box[3] = tile_range(center_x, -reach_x, reach_x, width)
    return (box[1] - box[0] + 1) * (box[3] - box[2] + 1)


@inline
def row_span(splats, bases, d, row, size):
    """First and last tile of a row of tiles that the ellipse of splat d touches.

    It is (A dx + B dy)^2 + (C dy)^2 <= (C REACH_Y)^2. Between the row's outermost pixel centres its
    right edge is farthest out at its tip, or, where the tip is not among them, at the centre
    nearest to it; the left edge mirrors it.
    """
    height, width, _ = size
    a = float(splats[d, col.A]) + float(splats[d, col.A_REST])
    b = float(splats[d, col.B]) + float(splats[d, col.B_REST])
    c = float(splats[d, col.C])
    center_x = float(bases[d, col.BASE_X]) + float(splats[d, col.X])
    center_y = float(bases[d, col.BASE_Y]) + float(splats[d, col.Y])
    reach = float(splats[d, col.REACH_Y])
    square = (c * reach) ** 2
    tilt = b / c
    tip = -tilt / math.sqrt(tilt * tilt + 1) * reach  # dy of the rightmost point
    low = row * col.TILE + 0.5 - col.PIXEL_MARGIN - center_y
    high = min((row + 1) * col.TILE, height) - 0.5 + col.PIXEL_MARGIN - center_y
    low, high = max(low, -reach), min(high, reach)
    right_dy = min(max(tip, low), high)
    left_dy = min(max(-tip, low), high)
    right = (math.sqrt(max(square - (c * right_dy) ** 2, 0.0)) - b * right_dy) / a
    left = (-math.sqrt(max(square - (c * left_dy) ** 2, 0.0)) - b * left_dy) / a
    return tile_range(center_x, left, right, width)


@inline
def list_tiles(splats, bases, d, box, size, exact, histogram, tiles, start):
    """Write the tiles of splat d from tiles[start] on, row by row, and add them to the histogram
    [tiles of an image]; how many they are.

    Args:
        box: see `find_box`.
        size: height and width in pixels, columns in tiles.
        exact: leave out the tiles of the box that the ellipse does not touch.
        tiles: with room for all of the box.
    """
    first_row, last_row, left, right = box[0], box[1], box[2], box[3]
    columns = size[2]
    exact = exact and right > left and last_row > first_row  # else it has no corners to miss
    count = 0
    for row in range(first_row, last_row + 1):
        first, last = left, right
        if exact:
            first, last = row_span(splats, bases, d, row, size)
            first, last = max(first, left), min(last, right)
        for column in range(first, last + 1):
            tile = row * columns + column
            histogram[tile] += 1
            tiles[start + count] = tile
            count += 1
    return count


@kernel
def place(start, stop, tiles, first_pair, positions, num, block_size, entries):
    """Write every pair (splat, its number among all pairs) of blocks start to stop into the lists.

    Args:
        tiles: [pairs] of each pair, within its image.
        first_pair: [images * N + 1] the number of a splat's first pair, and of all pairs.
        positions: [images, blocks, tiles] where a block's next pair of a tile goes.
        num, block_size: Gaussians of an image and of a block.
        entries: [pairs, 2] sorted by image and tile, then by Gaussian.
    """
    blocks = positions.shape[1]
    for index in range(start, stop):
        image, block = index // blocks, index % blocks
        next_entry = positions[image, block]
        for n in range(block * block_size, min((block + 1) * block_size, num)):
            d = image * num + n
            for pair in range(first_pair[d], first_pair[d + 1]):
                entry = next_entry[tiles[pair]]
                next_entry[tiles[pair]] = entry + 1
                entries[entry, 0], entries[entry, 1] = d, pair


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
