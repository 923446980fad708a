"""Which tiles a splat touches, and the list of splats of every tile.

One kernel walks through a splat's tiles, as it is stored: once to count them, and once, when there
is room for all, to write them down.
"""

from dataclasses import dataclass

import torch
import triton.language as tl
from jaxtyping import Float, Int
from torch import Tensor

from asysplat.ops.cuda.kernel import kernel
from asysplat.rendering.cuda.splat import load_ellipse
from asysplat.rendering.cuda.tile import TILE
from asysplat.rendering.limits import check_pairs

PIXEL_MARGIN = tl.constexpr(1e-3)  # so that rounding never drops what a pixel would have shown
BLOCK = 128


@dataclass(frozen=True)
class TileLists:
    """Depth-ordered splats of every tile; tiles are numbered image by image, row by row.

    Args:
        entries: [P] splat of each pair of splat and tile, sorted by tile, then by depth.
        pairs: [P] the number of each among all pairs.
        first_entry: [T + 1] where each tile's list begins.
        first_pair: [images * N] the number of a splat's first pair, where it has any.
    """

    entries: Int[Tensor, "P"]
    pairs: Int[Tensor, "P"]
    first_entry: Int[Tensor, "tile_ends"]
    first_pair: Int[Tensor, "splats"]


def sort_into_tiles(
    splats: Float[Tensor, "splats 16"],
    depths: Float[Tensor, "splats"],
    images: int,
    size: tuple[int, int],
    exact: bool,
) -> tuple[TileLists, Int[Tensor, "splats"], Int[Tensor, ""]]:
    """Sort the splats [images * N] of all images into tiles.

    Args:
        depths: 0 where there is no splat.
        size: height and width in pixels.
        exact: see `tile_columns`.

    Returns:
        The lists; how many pairs each splat has; how many all would have by their boxes.

    Raises:
        InputError: more pairs than a list can number.
    """
    height, width = size
    rows, columns = -(-height // TILE.value), -(-width // TILE.value)
    tiles = images * rows * columns
    device = splats.device
    visible = torch.nonzero(depths)[:, 0]
    # By depth across all images: the order of tiles, which comes second, parts these again.
    order = visible[torch.argsort(depths[visible], stable=True)]
    grid = (-(-len(order) // BLOCK),)
    frame = (len(order), len(depths) // images, height, width, columns, rows * columns)
    options = {"EXACT": exact, "BLOCK": BLOCK, "enable_fp_fusion": False}
    counts = torch.zeros(len(depths), dtype=torch.int32, device=device)
    boxes = torch.zeros(grid, dtype=torch.int32, device=device)
    nothing = (None,) * 4
    if len(order):
        list_tiles[grid](splats, order, counts, boxes, *nothing, *frame, PLACE=False, **options)
    ends = counts[order].cumsum(0)
    pairs = int(ends[-1]) if len(order) else 0
    check_pairs(pairs)
    # A GPU sorts short keys in fewer passes.
    key = next(t for t in (torch.int16, torch.int32, torch.int64) if tiles <= torch.iinfo(t).max)
    tile_of = torch.empty(pairs, dtype=key, device=device)
    owners = torch.empty(pairs, dtype=torch.int32, device=device)
    first_pair = torch.empty_like(counts)
    if pairs:
        places = (ends, tile_of, owners, first_pair)
        list_tiles[grid](splats, order, counts, None, *places, *frame, PLACE=True, **options)
    tile_of, numbers = torch.sort(tile_of, stable=True)
    starts = torch.arange(tiles + 1, dtype=key, device=device)
    first_entry = torch.searchsorted(tile_of, starts)
    return TileLists(owners[numbers], numbers, first_entry, first_pair), counts, boxes.sum()


@kernel
def list_tiles(
    splats,
    order,
    counts,
    boxes,
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
    PLACE: tl.constexpr,
    EXACT: tl.constexpr,
    BLOCK: tl.constexpr,
):
    """Walk through the tiles of BLOCK splats, by depth.

    Args:
        splats: [images * N, 16], N is `num`.
        order: [num_visible] those that are there.
        counts: [images * N] tiles of each; written without PLACE, read with it.
        boxes: [programs] tiles of all their boxes; written without PLACE.
        ends: [num_visible] the number behind a splat's last pair; this and the rest with PLACE.
        tile_of, owners: [pairs] tile and splat of each; written.
        first_pair: [images * N] written for those in `order`.
        columns, tiles: of an image.
    """
    rank = tl.program_id(0).to(tl.int64) * BLOCK + tl.arange(0, BLOCK)
    there = rank < num_visible
    d = tl.load(order + rank, mask=there, other=0)
    ellipse = load_ellipse(splats, d, there)
    first_row, last_row = tile_rows(ellipse, height)
    last_row = tl.where(there, last_row, first_row - 1)
    first_tile = d // num * tiles
    count = tl.zeros(rank.shape, tl.int32)
    if PLACE:
        first = tl.load(ends + rank, mask=there, other=0)
        first -= tl.load(counts + d, mask=there, other=0)
        tl.store(first_pair + d, first.to(tl.int32), mask=there)
    for step in range(tl.max(last_row - first_row, 0) + 1):
        row = first_row + step
        left, right = tile_columns(ellipse, row, height, width, EXACT)
        right = tl.where(row <= last_row, right, left - 1)
        if PLACE:
            for column_step in range(tl.max(right - left, 0) + 1):
                column = left + column_step
                here = column <= right
                pair = first + count + column_step
                tl.store(tile_of + pair, first_tile + row * columns + column, mask=here)
                tl.store(owners + pair, d.to(tl.int32), mask=here)
        count += right - left + 1
    if not PLACE:
        tl.store(counts + d, count, mask=there)
        left, right = box_columns(ellipse, width)
        box = (last_row - first_row + 1) * (right - left + 1)
        tl.store(boxes + tl.program_id(0), tl.sum(box, 0))


@kernel
def tile_range(center, below, above, size):
    """First and last tile that has a pixel centre from center - below to center + above, of an
    image of `size` pixels; the last is before the first where there is none. What is not a number
    is the image's edge."""
    first, last = center - below - 0.5 - PIXEL_MARGIN, center + above - 0.5 + PIXEL_MARGIN
    # Limited as a float: a number beyond int32 has no int.
    first = tl.where(first > 0, tl.minimum(first, size * 1.0), 0.0)
    last = tl.where(last < size - 1, tl.maximum(last, -1.0), size - 1.0)
    first, last = tl.ceil(first).to(tl.int32), tl.floor(last).to(tl.int32)
    return first // TILE, tl.where(first <= last, last // TILE, first // TILE - 1)


@kernel
def tile_rows(ellipse, height):
    """First and last row of tiles."""
    _, y, _, _, _, reach = ellipse
    return tile_range(y, reach, reach, height)


@kernel
def box_columns(ellipse, width):
    """First and last tile of a row of tiles that its box touches."""
    x, _, a, b, c, reach = ellipse
    tilt = b / c
    half_width = c * reach * tl.sqrt(1 + tilt * tilt) / a
    return tile_range(x, half_width, half_width, width)


@kernel
def tile_columns(ellipse, row, height, width, EXACT: tl.constexpr):
    """First and last tile of a row of tiles that the ellipse touches, or, if not EXACT, its box.

    It is (a dx + b dy)^2 + (c dy)^2 <= (c reach)^2. Between the row's outermost pixel centres its
    right edge is farthest out at its tip, or, where the tip is not among them, at the centre
    nearest to it; the left edge mirrors it.
    """
    if not EXACT:
        return box_columns(ellipse, width)
    x, y, a, b, c, reach = ellipse
    square = (c * reach) * (c * reach)
    tilt = b / c
    tip = -tilt / tl.sqrt(tilt * tilt + 1) * reach  # dy of the rightmost point
    low = (row * TILE).to(tl.float64) + (0.5 - PIXEL_MARGIN) - y
    high = tl.minimum((row + 1) * TILE, height).to(tl.float64) - (0.5 - PIXEL_MARGIN) - y
    low, high = tl.maximum(low, -reach), tl.minimum(high, reach)
    right_dy = tl.minimum(tl.maximum(tip, low), high)
    left_dy = tl.minimum(tl.maximum(-tip, low), high)
    right_v, left_v = c * right_dy, c * left_dy
    right = (tl.sqrt(tl.maximum(square - right_v * right_v, 0.0)) - b * right_dy) / a
    left = (-tl.sqrt(tl.maximum(square - left_v * left_v, 0.0)) - b * left_dy) / a
    return tile_range(x, -left, right, width)
