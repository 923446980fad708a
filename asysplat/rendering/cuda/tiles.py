"""Compute which tiles a splat touches, and the list of splats of every tile.

One kernel visits the tiles of a stored splat: first to count them, then, with memory allocated for
all pairs, to write them.
"""

from typing import NamedTuple

import triton.language as tl
from torch import Tensor

from asysplat.kernels.triton_utils import kernel
from asysplat.rendering import formulas
from asysplat.rendering.cuda.splat import TILE, load_ellipse

PIXEL_MARGIN = tl.constexpr(formulas.PIXEL_MARGIN)


class TileLists(NamedTuple):
    """The splats of every tile, by depth; see `cpu.tiles.TileLists`.

    counts [images * N] pairs of each splat; first_pair [images * N]; entries [pairs] the splat of
    each pair and pairs [pairs] its index, sorted by tile, then by depth; active None if all tiles
    are.
    """

    splats: Tensor
    counts: Tensor
    first_pair: Tensor
    first_entry: Tensor
    entries: Tensor
    pairs: Tensor
    active: Tensor | None


@kernel
def list_tiles(
    splats,
    order,
    counts,
    box_tiles,
    ends,
    tile_of,
    owners,
    first_pair,
    num_visible,
    num,
    height,
    width,
    columns,
    tiles,
    WRITE: tl.constexpr,
    CULL_ELLIPSE: tl.constexpr,
    BLOCK: tl.constexpr,
):
    """Visit the tiles of BLOCK splats, in the `order` [num_visible] of their depths.

    Without WRITE, write the counts [images * N] of tiles and box_tiles [programs]. With WRITE,
    write tile_of and owners [pairs], the tile and splat of each pair, and first_pair [images * N];
    ends [num_visible] is 1 + the index of a splat's last pair.
    """
    rank = tl.program_id(0).to(tl.int64) * BLOCK + tl.arange(0, BLOCK)
    valid = rank < num_visible
    d = tl.load(order + rank, mask=valid, other=0)
    ellipse = load_ellipse(splats, d, valid)
    first_row, last_row = tile_rows(ellipse, height)
    last_row = tl.where(valid, last_row, first_row - 1)
    first_tile = d // num * tiles
    count = tl.zeros(rank.shape, tl.int32)
    if WRITE:
        first = tl.load(ends + rank, mask=valid, other=0)
        first -= tl.load(counts + d, mask=valid, other=0)
        tl.store(first_pair + d, first.to(tl.int32), mask=valid)
    for step in range(tl.max(last_row - first_row, 0) + 1):
        row = first_row + step
        left, right = row_span(ellipse, row, height, width, CULL_ELLIPSE)
        right = tl.where(row <= last_row, right, left - 1)
        if WRITE:
            for column_step in range(tl.max(right - left, 0) + 1):
                column = left + column_step
                in_span = column <= right
                pair = first + count + column_step
                tl.store(tile_of + pair, first_tile + row * columns + column, mask=in_span)
                tl.store(owners + pair, d.to(tl.int32), mask=in_span)
        count += right - left + 1
    if not WRITE:
        tl.store(counts + d, count, mask=valid)
        left, right = box_columns(ellipse, width)
        box = (last_row - first_row + 1) * (right - left + 1)
        tl.store(box_tiles + tl.program_id(0), tl.sum(box, 0))


@kernel
def tile_range(center, start, stop, size):
    """See `cpu.tiles.tile_range`."""
    first, last = center + start - 0.5 - PIXEL_MARGIN, center + stop - 0.5 + PIXEL_MARGIN
    # Clamp the float: a number beyond int32 has no int.
    first = tl.where(first > 0, tl.minimum(first, size * 1.0), 0.0)
    last = tl.where(last < size - 1, tl.maximum(last, -1.0), size - 1.0)
    first, last = tl.ceil(first).to(tl.int32), tl.floor(last).to(tl.int32)
    return first // TILE, tl.where(first <= last, last // TILE, first // TILE - 1)


@kernel
def tile_rows(ellipse, height):
    """Compute the first and the last row of tiles that the ellipse touches."""
    _, y, _, _, _, extent = ellipse
    return tile_range(y, -extent, extent, height)


@kernel
def box_columns(ellipse, width):
    """Compute the first and the last tile of a row of tiles that the ellipse's box touches."""
    x, _, a, b, c, extent = ellipse
    tilt = b / c
    half_width = c * extent * tl.sqrt(1 + tilt * tilt) / a
    return tile_range(x, -half_width, half_width, width)


@kernel
def row_span(ellipse, row, height, width, CULL_ELLIPSE: tl.constexpr):
    """See `cpu.tiles.row_span`; without CULL_ELLIPSE the tiles of the ellipse's box."""
    if not CULL_ELLIPSE:
        return box_columns(ellipse, width)
    x, y, a, b, c, extent = ellipse
    inverse_a, square = 1 / a, (c * extent) * (c * extent)
    tilt = b / c
    tip = -tilt / tl.sqrt(tilt * tilt + 1) * extent  # dy of the rightmost point
    low = (row * TILE).to(tl.float64) + (0.5 - PIXEL_MARGIN) - y
    high = tl.minimum((row + 1) * TILE, height).to(tl.float64) - (0.5 - PIXEL_MARGIN) - y
    low, high = tl.maximum(low, -extent), tl.minimum(high, extent)
    right_dy = tl.minimum(tl.maximum(tip, low), high)
    left_dy = tl.minimum(tl.maximum(-tip, low), high)
    right_v, left_v = c * right_dy, c * left_dy
    right = (tl.sqrt(tl.maximum(square - right_v * right_v, 0.0)) - b * right_dy) * inverse_a
    left = (-tl.sqrt(tl.maximum(square - left_v * left_v, 0.0)) - b * left_dy) * inverse_a
    return tile_range(x, left, right, width)
