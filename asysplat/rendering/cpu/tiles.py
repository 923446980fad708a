"""Compute which tiles of 16x16 pixels a splat touches, and the list of splats of every tile.

The projection computes the tiles of each splat once, and the lists are built from them. The thread
that draws a tile sorts its list by depth.
"""

import math
from typing import NamedTuple

import numpy as np

from asysplat.kernels.simd.threads import inline, kernel
from asysplat.rendering.cpu.splat import DEPTH, DEPTH_REST, TILE
from asysplat.rendering.formulas import MAX_CENTER_OFFSET, PIXEL_MARGIN

INSERTION_SORT_LENGTH = 32  # lists up to this are sorted by insertion
RADIX = 256
DIGITS = 4


class TileLists(NamedTuple):
    """The splats of every tile, sorted by Gaussian until `rasterize` sorts them by depth."""

    splats: np.ndarray  # [images * N, 16], see `splat`
    first_pair: np.ndarray  # [images * N + 1] index of each splat's first pair; number of pairs
    first_entry: np.ndarray  # [tiles + 1] start of each tile's list
    entries: np.ndarray  # [pairs, 2] splat and pair, sorted by tile
    active: np.ndarray  # [tiles] whether any pixel of the tile counts


@inline
def tile_range(center, start, stop, size):
    """Compute the first and the last tile that has a pixel center in center + [start, stop].

    The image has `size` pixels; the last tile is before the first if there is none. NaN means the
    image's edge.
    """
    first, last = center + start - 0.5 - PIXEL_MARGIN, center + stop - 0.5 + PIXEL_MARGIN
    # Clamp the float: a number beyond int64 has no int.
    first = int(np.ceil(min(first, float(size)))) if first > 0 else 0
    last = int(np.floor(max(last, -1.0))) if last < size - 1 else size - 1
    return first // TILE, last // TILE if last >= first else first // TILE - 1


@inline
def compute_box(ellipse, extent_x, frame, box):
    """Write the first and last row and column of tiles in an ellipse's box; return their number."""
    x, y, extent_y = ellipse.x, ellipse.y, ellipse.extent_y
    box[0], box[1] = tile_range(y, -extent_y, extent_y, frame.height)
    box[2], box[3] = tile_range(x, -extent_x, extent_x, frame.width)
    return (box[1] - box[0] + 1) * (box[3] - box[2] + 1)


@inline
def row_span(ellipse, row, frame):
    """Compute the first and the last tile of a row of tiles that the ellipse touches.

    Between the row's outermost pixel centers, the ellipse's right edge is farthest out at its tip
    or, if the tip lies outside of them, at the center nearest to it; the left edge mirrors it.
    """
    a, b, c, extent = ellipse.a, ellipse.b, ellipse.c, ellipse.extent_y
    square = (c * extent) ** 2
    tilt = b / c
    tip = -tilt / math.sqrt(tilt * tilt + 1) * extent  # dy of the rightmost point
    low = row * TILE + 0.5 - PIXEL_MARGIN - ellipse.y
    high = min((row + 1) * TILE, frame.height) - 0.5 + PIXEL_MARGIN - ellipse.y
    low, high = max(low, -extent), min(high, extent)
    right_dy = min(max(tip, low), high)
    left_dy = min(max(-tip, low), high)
    right = (math.sqrt(max(square - (c * right_dy) ** 2, 0.0)) - b * right_dy) / a
    left = (-math.sqrt(max(square - (c * left_dy) ** 2, 0.0)) - b * left_dy) / a
    return tile_range(ellipse.x, left, right, frame.width)


@inline
def list_tiles(ellipse, box, frame, histogram, tiles, start):
    """Write a splat's tiles to tiles[start:], count them in the histogram; return their number."""
    first_row, last_row, left, right = box[0], box[1], box[2], box[3]
    # The ellipse touches every tile of a box of one row or one column; an extent may be cut short.
    exact = frame.project.cull_ellipse and right > left and last_row > first_row
    exact = exact and ellipse.extent_y < MAX_CENTER_OFFSET
    count = 0
    for row in range(first_row, last_row + 1):
        first, last = left, right
        if exact:
            first, last = row_span(ellipse, row, frame)
            first, last = max(first, left), min(last, right)
        for column in range(first, last + 1):
            tile = row * frame.columns + column
            histogram[tile] += 1
            tiles[start + count] = tile
            count += 1
    return count


@kernel
def start_positions(start, stop, histograms, first_entry, positions):
    """Convert counts to first positions, [images, blocks, tiles], of images start to stop."""
    blocks, tiles = histograms.shape[1:]
    for image in range(start, stop):
        for tile in range(tiles):
            position = first_entry[image * tiles + tile]
            for block in range(blocks):
                positions[image, block, tile] = position
                position += histograms[image, block, tile]


@kernel
def scatter_pairs(start, stop, tiles, first_pair, positions, frame, entries):
    """Write every pair of splat and tile of blocks start to stop into the lists.

    tiles [pairs] is the tile of each pair, within its image; positions [images, blocks, tiles] the
    index of a block's next entry of a tile; entries [pairs, 2], see `TileLists`, is written.
    """
    for index in range(start, stop):
        image, block = index // frame.blocks, index % frame.blocks
        next_entry = positions[image, block]
        first = block * frame.block_size
        for n in range(first, min(first + frame.block_size, frame.num)):
            d = image * frame.num + n
            for pair in range(first_pair[d], first_pair[d + 1]):
                entry = next_entry[tiles[pair]]
                next_entry[tiles[pair]] = entry + 1
                entries[entry, 0], entries[entry, 1] = d, pair


@inline
def sort_by_depth(lists, start, stop, keys, scratch, counts):
    """Sort entries[start:stop] of a tile by the exact depth, then by Gaussian; stable.

    Depths are positive, so that their bits sort alike. keys [2, m] and scratch [2, m, 2] have
    m >= stop - start; counts is [DIGITS, RADIX].
    """
    entries, splats = lists.entries, lists.splats
    length = stop - start
    if length > INSERTION_SORT_LENGTH:
        _radix_sort(lists, start, length, keys, scratch, counts)
    # The rounding errors of the depths break ties of float32, which are short runs.
    for i in range(start + 1, stop):
        d, pair = entries[i, 0], entries[i, 1]
        depth, rest = splats[d, DEPTH], splats[d, DEPTH_REST]
        j = i - 1
        while j >= start:
            other = entries[j, 0]
            if splats[other, DEPTH] < depth:
                break
            if splats[other, DEPTH] == depth and splats[other, DEPTH_REST] <= rest:
                break
            entries[j + 1, 0], entries[j + 1, 1] = other, entries[j, 1]
            j -= 1
        entries[j + 1, 0], entries[j + 1, 1] = d, pair


@inline
def _radix_sort(lists, start, length, keys, scratch, counts):
    """Sort by the 32 bits of the float32 depth, 8 at a time."""
    entries, bits = lists.entries, lists.splats.view(np.uint32)
    counts[:] = 0
    for i in range(length):
        key = bits[entries[start + i, 0], DEPTH]
        keys[0, i] = key
        scratch[0, i, 0], scratch[0, i, 1] = entries[start + i, 0], entries[start + i, 1]
        for digit in range(DIGITS):
            counts[digit, (key >> np.uint32(8 * digit)) & np.uint32(RADIX - 1)] += 1
    source = 0
    for digit in range(DIGITS):
        shift = np.uint32(8 * digit)
        if counts[digit, (keys[source, 0] >> shift) & np.uint32(RADIX - 1)] == length:
            continue  # all keys have the same digit
        position = 0
        for value in range(RADIX):
            count = counts[digit, value]
            counts[digit, value] = position
            position += count
        for i in range(length):
            key = keys[source, i]
            value = (key >> shift) & np.uint32(RADIX - 1)
            position = counts[digit, value]
            counts[digit, value] = position + 1
            keys[1 - source, position] = key
            scratch[1 - source, position, 0] = scratch[source, i, 0]
            scratch[1 - source, position, 1] = scratch[source, i, 1]
        source = 1 - source
    for i in range(length):
        entries[start + i, 0], entries[start + i, 1] = scratch[source, i, 0], scratch[source, i, 1]
