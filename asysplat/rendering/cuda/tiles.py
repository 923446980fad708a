"""Which splats touch which tile of the image."""

import math
from dataclasses import dataclass

import torch
from jaxtyping import Float, Int
from torch import Tensor

from asysplat.rendering.limits import check_pairs
from asysplat.rendering.settings import Settings

TILE = 8  # pixels a side

# What a skip leaves standing, so that rounding never drops what a pixel would have shown.
EXPONENT_MARGIN = 1e-3  # of log2 alpha
PIXEL_MARGIN = 1e-3
ROUNDING = 1e-6  # of lengths in float32


@dataclass(frozen=True)
class TileLists:
    """Depth-ordered splats of every tile; tiles are numbered image by image, row by row.

    Args:
        images, height, width: of what is drawn, in pixels.
        rows, columns: of tiles of size x size pixels.
        entries: [P] splat of each pair of splat and tile, sorted by tile, then by depth.
        pairs: [P] number of each among all pairs, sorted by splat.
        first_entry: [T + 1] where each tile's list begins.
        first_pair: [M + 1] where each splat's pairs begin.
        off_ellipse: how many more pairs there would be with boxes in the place of ellipses.
    """

    images: int
    height: int
    width: int
    size: int
    rows: int
    columns: int
    entries: Int[Tensor, "P"]
    pairs: Int[Tensor, "P"]
    first_entry: Int[Tensor, "tile_ends"]
    first_pair: Int[Tensor, "splat_ends"]
    off_ellipse: int


@torch.no_grad()
def assign_tiles(
    image_of: Int[Tensor, "M"],
    splats: Float[Tensor, "M C"],
    images: int,
    size: tuple[int, int],
    settings: Settings,
) -> TileLists:
    """Sort splats, which come in depth order within their image, into tiles.

    Args:
        image_of, splats: from `project`.
        images: how many there are.
        size: height and width in pixels.
    """
    height, width = size
    rows, columns = -(-height // TILE), -(-width // TILE)
    ellipses = _Ellipses(splats, settings)
    box_rows = _tiles(*ellipses.vertical(), height)
    box_columns = _tiles(*ellipses.horizontal(), width)
    # First into rows of tiles, then each row into tiles.
    spans = _lengths(*box_rows)
    owner, step = _expand(spans)
    row = box_rows[0][owner] + step
    if settings.skips.ellipse:
        first, last = _tiles(*ellipses.horizontal_within(owner, row), width)
    else:
        first, last = box_columns[0][owner], box_columns[1][owner]
    counts = _lengths(first, last)
    boxes = (spans * _lengths(*box_columns)).sum()
    total, total_of_boxes = torch.stack((counts.sum(), boxes)).tolist()
    check_pairs(total)
    strip, step = _expand(counts, total)
    tile = ((image_of[owner] * rows + row) * columns + first)[strip] + step
    tiles = images * rows * columns
    # A GPU sorts short keys in fewer passes; a stable sort keeps the order of depths.
    key = torch.int16 if tiles < 2**15 else torch.int32
    tile, pairs = torch.sort(tile.to(key), stable=True)
    return TileLists(
        images=images,
        height=height,
        width=width,
        size=TILE,
        rows=rows,
        columns=columns,
        entries=owner[strip[pairs]].int(),
        pairs=pairs,
        first_entry=torch.searchsorted(
            tile, torch.arange(tiles + 1, dtype=key, device=tile.device)
        ),
        first_pair=_starts(counts)[_starts(spans)],
        off_ellipse=total_of_boxes - total if settings.skips.ellipse else 0,
    )


class _Ellipses:
    """Where splats have alpha >= alpha_min: (a dx + b dy)^2 + (c dy)^2 <= reach^2."""

    def __init__(self, splats: Tensor, settings: Settings):
        self.x, self.y, self.a, b, self.c, opacity = splats[:, :6].unbind(-1)
        self.tilt = b / self.c
        room = opacity.log2() if settings.skips.extent else torch.zeros_like(opacity)
        room = room - math.log2(settings.convention.alpha_min) + EXPONENT_MARGIN
        self.reach = room.clamp_min(0).sqrt()
        self.half_width = self.reach * (1 + self.tilt.square()).sqrt() / self.a
        # Far from a needle's centre the two terms of the first square nearly cancel.
        self.margin = PIXEL_MARGIN + ROUNDING * (self.x.abs() + self.half_width)

    def vertical(self) -> tuple[Tensor, Tensor]:
        """Least and greatest y."""
        half = self.reach / self.c + PIXEL_MARGIN + ROUNDING * self.y.abs()
        return self.y - half, self.y + half

    def horizontal(self) -> tuple[Tensor, Tensor]:
        """Least and greatest x."""
        half = self.half_width + self.margin
        return self.x - half, self.x + half

    def horizontal_within(self, index: Tensor, row: Tensor) -> tuple[Tensor, Tensor]:
        """Least and greatest x of the splats `index` between the outermost pixel centres of the
        given rows of tiles.

        There the right edge is farthest out at its tip, or, where the tip is not between them, at
        the centre nearest to it; the left edge mirrors it.
        """
        x, y, a, c, tilt, reach, margin = (
            t[index] for t in (self.x, self.y, self.a, self.c, self.tilt, self.reach, self.margin)
        )
        low = row * TILE + 0.5 - PIXEL_MARGIN - y
        high = low + (TILE - 1 + 2 * PIXEL_MARGIN)
        low, high = (c * low).clamp(-reach, reach), (c * high).clamp(-reach, reach)
        tip = -reach * tilt / (1 + tilt.square()).sqrt()  # c dy of the rightmost point
        right, left = tip.clamp(low, high), (-tip).clamp(low, high)
        right_edge = ((reach.square() - right.square()).clamp_min(0).sqrt() - tilt * right) / a
        left_edge = (-(reach.square() - left.square()).clamp_min(0).sqrt() - tilt * left) / a
        return x + left_edge - margin, x + right_edge + margin


def _tiles(low: Tensor, high: Tensor, pixels: int) -> tuple[Tensor, Tensor]:
    """First and last tile, along one axis, with a pixel centre from `low` to `high`; the last is
    before the first where there is none."""
    first = (low - 0.5).ceil().clamp(0, pixels).long()
    last = (high - 0.5).floor().clamp(-1, pixels - 1).long()
    return first // TILE, torch.where(first <= last, last // TILE, -1)


def _lengths(first: Tensor, last: Tensor) -> Tensor:
    return (last - first + 1).clamp_min(0)


def _starts(counts: Tensor) -> Tensor:
    """[0, c_0, c_0 + c_1, ...]"""
    return torch.nn.functional.pad(counts.cumsum(0), (1, 0))


def _expand(counts: Tensor, total: int | None = None) -> tuple[Tensor, Tensor]:
    """Index i counts[i] times, and 0, 1, ... to each."""
    owner = torch.repeat_interleave(counts, output_size=total)
    return owner, torch.arange(len(owner), device=owner.device) - _starts(counts)[owner]
