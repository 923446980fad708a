"""Compute which tiles a splat touches, and the list of splats of every tile."""

from dataclasses import dataclass

import torch
from jaxtyping import Float, Int
from torch import Tensor

from asysplat.rendering.interface import check_pairs
from asysplat.rendering.reference.project import Splats


@dataclass(frozen=True)
class TileLists:
    """Depth-ordered splats of every tile; tiles are numbered image by image, row by row."""

    size: int  # pixels a side
    images: int  # the grid of tiles has images x rows x columns
    rows: int
    columns: int
    splats: Int[Tensor, "pairs"]  # splat of every pair, sorted by tile, then by depth
    lengths: Int[Tensor, "T"]  # number of pairs of each tile

    def origins(self, tiles: Int[Tensor, "t"]) -> Int[Tensor, "t 2"]:
        """Return the pixel (x, y) at the upper left corner of the given tiles."""
        column, row = tiles % self.columns, tiles // self.columns % self.rows
        return torch.stack((column, row), -1) * self.size

    def to_images(
        self, values: Float[Tensor, "T C P"], height: int, width: int
    ) -> Float[Tensor, "images C {height} {width}"]:
        """Arrange the values of all tiles' pixels as images."""
        grid = values.unflatten(0, (self.images, self.rows, self.columns))
        grid = grid.unflatten(-1, (self.size, self.size))
        return grid.permute(0, 3, 1, 4, 2, 5).flatten(4, 5).flatten(2, 3)[..., :height, :width]


@torch.no_grad()
def list_tiles(splats: Splats, images: int, height: int, width: int, size: int) -> TileLists:
    """Sort the splats of `images` images into tiles of size x size pixels."""
    rows, columns = -(-height // size), -(-width // size)
    first, last = splats.first // size, splats.last // size
    # Rounding can empty a range after the visibility test.
    spans = (last - first + 1).clamp_min(0)
    counts = spans.prod(-1)
    check_pairs(int(counts.sum()))
    splat = torch.repeat_interleave(counts)
    step = torch.arange(len(splat), device=splat.device) - (counts.cumsum(0) - counts)[splat]
    corner = (splats.images * rows + first[:, 1]) * columns + first[:, 0]
    span_x = spans[splat, 0]
    tile = corner[splat] + step // span_x * columns + step % span_x
    # Splats come in depth order within their image, and a stable sort by tile keeps it.
    order = torch.argsort(tile, stable=True)
    lengths = torch.bincount(tile, minlength=images * rows * columns)
    return TileLists(size, images, rows, columns, splat[order], lengths)
