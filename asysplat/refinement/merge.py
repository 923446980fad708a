"""Merge Gaussians that say the same: many views see one surface."""

import torch
import torch.nn.functional as F
from jaxtyping import Float, Int
from torch import Tensor

from asysplat.refinement.start import SPREAD, footprints
from asysplat.scene import Cameras, Gaussians

LEAST_OPACITY, MOST_OPACITY = 0.05, 0.95  # what is merged keeps a gradient
COARSER = 2**0.5  # by which cells grow until few enough Gaussians are left


def merged(gaussians: Gaussians, cells: Float[Tensor, "N"]) -> Gaussians:
    """Merge the Gaussians of each cubic cell: their mean, weighted by opacity.

    Together they hide what all of them hid, in the range from LEAST_OPACITY to MOST_OPACITY. What
    is left covers its cell.

    Args:
        gaussians: [N], N >= 1.
        cells: side of the cell that each is in, > 0, in scene units; rounded to a power of 2, so
            that cells of one size tile the space, from the least corner of all means.
    """
    cell, count = _ranks_of_cells(gaussians.means, cells)
    weights = gaussians.opacities.clamp_min(1e-6)  # what nobody sees has a mean, too
    total = weights.new_zeros(count).index_add_(0, cell, weights)

    def mean(values: Tensor) -> Tensor:
        shape = (-1, *[1] * (values.ndim - 1))
        summed = values.new_zeros(count, *values.shape[1:])
        return summed.index_add_(0, cell, values * weights.view(shape)) / total.view(shape)

    hidden = torch.log1p(-gaussians.opacities.clamp(max=0.999))
    opacities = 1 - weights.new_zeros(count).index_add_(0, cell, hidden).exp()
    # q and -q are one rotation: all of a cell are turned to the side of its first.
    every = torch.arange(len(cell))
    first = every.new_full((count,), len(cell)).scatter_reduce_(0, cell, every, "amin")[cell]
    quats = F.normalize(gaussians.quats, dim=-1)
    opposite = (quats * quats[first]).sum(-1, keepdim=True) < 0
    scales = mean(gaussians.scales.log()).exp()
    return Gaussians(
        means=mean(gaussians.means),
        quats=F.normalize(mean(torch.where(opposite, -quats, quats)), dim=-1),
        scales=torch.maximum(scales, SPREAD * mean(cells.log()).exp()[:, None]),
        opacities=opacities.clamp(LEAST_OPACITY, MOST_OPACITY),
        sh=mean(gaussians.sh),
    )


def thinned(gaussians: Gaussians, cameras: Cameras, pixels: float, most: int) -> Gaussians:
    """Merge Gaussians in cells of `pixels`, and of more until at most `most` are left.

    Args:
        gaussians: [N], N >= 1.
        cameras: that see them.
        pixels: > 0, side of a cell, in pixels of the camera that sees it closest.
        most: >= 1.

    Raises:
        InputError: values that cannot be used.
    """
    gaussians.validate("thinned's gaussians")
    cells = pixels * footprints(gaussians.means, cameras)
    extent = (gaussians.means.amax(0) - gaussians.means.amin(0)).max()
    largest = torch.maximum(2 * extent, cells.max())  # it holds all of them
    while _ranks_of_cells(gaussians.means, cells)[1] > most and cells.min() < largest:
        cells = torch.minimum(COARSER * cells, largest)
    return merged(gaussians, cells)


def _ranks_of_cells(
    means: Float[Tensor, "N 3"], cells: Float[Tensor, "N"]
) -> tuple[Int[Tensor, "N"], int]:
    """Give each mean the rank of its cell, from 0, and tell how many cells there are."""
    level = cells.double().log2().round()
    offsets = means.double() - means.double().amin(0)
    place = (offsets / (2**level)[:, None]).floor()
    ranks, count = _ranks(level)
    for axis in place.unbind(-1):
        # Ranks, as places themselves may be too large for an integer that holds all three.
        along, length = _ranks(axis)
        ranks, count = _ranks(ranks * length + along)
    return ranks, count


def _ranks(values: Tensor) -> tuple[Int[Tensor, "N"], int]:
    ordered, ranks = values.unique(return_inverse=True)
    return ranks, len(ordered)
