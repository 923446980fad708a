"""Compute which tiles a splat touches, and the list of splats of every tile.

One kernel visits the tiles of a stored splat: first to count them, then, with memory allocated for
the pairs, to write those that find room.
"""

from typing import NamedTuple

import triton.language as tl
from torch import Tensor

from asysplat.kernels.triton_utils import kernel
from asysplat.rendering import formulas
from asysplat.rendering.cuda.math import clamp
from asysplat.rendering.cuda.splat import MAX_CENTER_OFFSET, TILE, load_ellipse

PIXEL_MARGIN = tl.constexpr(formulas.PIXEL_MARGIN)
ROUNDING = tl.constexpr(1e-6)  # of float32, relative; an ellipse is widened by it
MAX_TILT = tl.constexpr(1e15)
MAX_OFFSET = tl.constexpr(2.0**30 - 128)  # pixels: twice as many fit int32


class TileLists(NamedTuple):
    """The splats of every tile, by depth; see `cpu.tiles.TileLists`.

    There may be more room than pairs; what is beyond them is arbitrary.
    """

    splats: Tensor
    counts: Tensor  # [images * N] pairs of each splat
    first_pair: Tensor  # [images * N]
    first_entry: Tensor
    entries: Tensor  # [room] splat of each pair, sorted by tile, then by depth
    places: Tensor | None  # [room] where in `entries` each pair is; None without gradients
    active: Tensor | None  # None if all tiles are


@kernel
def list_tiles(
    splats,
    depths,  # [images * N], infinite where there is no splat
    order,  # [images * N] splats by depth
    counts,  # [images * N] tiles of each splat
    box_tiles,  # [programs]
    ends,  # [images * N] 1 + the index of a splat's last pair, in `order`
    tile_of,  # [room] tile of each pair
    owners,  # [room] splat of each pair
    first_pair,  # [images * N]
    num_splats,  # images * N
    room,
    num,
    height,
    width,
    columns,
    tiles,
    WRITE: tl.constexpr,
    CULL_ELLIPSE: tl.constexpr,
    BLOCK: tl.constexpr,
):
    """Count the tiles of BLOCK splats, and of their boxes; with WRITE, list these pairs instead."""
    rank = tl.program_id(0).to(tl.int64) * BLOCK + tl.arange(0, BLOCK)
    exists = rank < num_splats
    d = tl.load(order + rank, mask=exists, other=0)
    valid = tl.load(depths + d, mask=exists, other=float("inf")) < float("inf")
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
                pair = first + count + column_step
                in_span = (column <= right) & (pair < room)
                tl.store(tile_of + pair, first_tile + row * columns + column, mask=in_span)
                tl.store(owners + pair, d.to(tl.int32), mask=in_span)
        count += right - left + 1
    if not WRITE:
        tl.store(counts + d, count, mask=exists)
        left, right = box_columns(ellipse, width)
        box = (last_row - first_row + 1) * (right - left + 1)
        tl.store(box_tiles + tl.program_id(0), tl.sum(box, 0))


@kernel
def list_entries(
    numbers,  # [room] pairs, sorted by tile
    owners,
    entries,  # [room] their splats
    places,  # [room] the index of each pair in `numbers`; None without KEEP
    room,
    KEEP: tl.constexpr,
    BLOCK: tl.constexpr,
):
    """List the splats of the tiles."""
    place = tl.program_id(0).to(tl.int64) * BLOCK + tl.arange(0, BLOCK)
    exists = place < room
    pair = tl.load(numbers + place, mask=exists, other=0)
    tl.store(entries + place, tl.load(owners + pair, mask=exists), mask=exists)
    if KEEP:
        tl.store(places + pair, place.to(tl.int32), mask=exists)


@kernel
def tile_range(base, start, stop, margin, size):
    """Compute the first and the last tile that has a pixel center in base + [start, stop].

    `margin` widens the range by what rounding can move it; see `cpu.tiles.tile_range`.
    """
    first = tl.ceil(tl.maximum(start - 0.5 - margin, -MAX_OFFSET))
    last = tl.floor(tl.minimum(stop - 0.5 + margin, MAX_OFFSET))
    # A range to the image's edge, where the number is NaN too.
    first = tl.where(first > -MAX_OFFSET, tl.minimum(first, MAX_OFFSET).to(tl.int32) + base, 0)
    last = tl.where(last < MAX_OFFSET, tl.maximum(last, -MAX_OFFSET).to(tl.int32) + base, size)
    first, last = tl.minimum(tl.maximum(first, 0), size), tl.minimum(tl.maximum(last, -1), size - 1)
    return first // TILE, tl.where(first <= last, last // TILE, first // TILE - 1)


@kernel
def tile_rows(ellipse, height):
    """Compute the first and the last row of tiles that the ellipse touches."""
    _, _, base, y, _, _, _, extent = ellipse
    return tile_range(base, y - extent, y + extent, PIXEL_MARGIN + ROUNDING * extent, height)


@kernel
def box_columns(ellipse, width):
    """Compute the first and the last tile of a row of tiles that the ellipse's box touches."""
    base, x, _, _, a, b, c, extent = ellipse
    half = tl.sqrt(b * b + c * c) * extent / a
    return tile_range(base, x - half, x + half, PIXEL_MARGIN + ROUNDING * half, width)


@kernel
def row_span(ellipse, row, height, width, CULL_ELLIPSE: tl.constexpr):
    """See `cpu.tiles.row_span`; without CULL_ELLIPSE the tiles of the ellipse's box."""
    if not CULL_ELLIPSE:
        return box_columns(ellipse, width)
    base_x, x, base_y, y, a, b, c, extent = ellipse
    tilt = clamp(b / c, -MAX_TILT, MAX_TILT)
    tip = -tilt / tl.sqrt(tilt * tilt + 1) * extent  # dy of the rightmost point
    margin = PIXEL_MARGIN + ROUNDING * extent
    low = (row * TILE - base_y).to(tl.float32) + (0.5 - margin - y)
    high = (tl.minimum((row + 1) * TILE, height) - base_y).to(tl.float32) - (0.5 - margin + y)
    low, high = tl.maximum(low, -extent), tl.minimum(high, extent)
    right_dy = tl.minimum(tl.maximum(tip, low), high)
    left_dy = tl.minimum(tl.maximum(-tip, low), high)
    slope, flatness = b / a, c / a
    right_half = flatness * half_chord(extent, right_dy)
    left_half = flatness * half_chord(extent, left_dy)
    right, left = right_half - slope * right_dy, -left_half - slope * left_dy
    margin = tl.maximum(right_half, left_half) + tl.abs(slope) * extent
    span = tile_range(base_x, x + left, x + right, PIXEL_MARGIN + ROUNDING * margin, width)
    box, whole = box_columns(ellipse, width), extent < MAX_CENTER_OFFSET  # else it is cut short
    return tl.where(whole, span[0], box[0]), tl.where(whole, span[1], box[1])


@kernel
def half_chord(radius, height):
    """Compute half of a circle's chord at a height."""
    return tl.sqrt(tl.maximum((radius - height) * (radius + height), 0.0))
