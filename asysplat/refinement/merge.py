"""Merge Gaussians of several views that lie on the same surface."""

import torch
import torch.nn.functional as F
from jaxtyping import Float, Int
from torch import Tensor

from asysplat.kernels.dispatch import to_float64
from asysplat.refinement.isotropic import footprints
from asysplat.scene import Cameras, Gaussians

SPREAD = 0.5  # standard deviation of a Gaussian, in sides of the cell that it covers
MIN_OPACITY, MAX_OPACITY = 0.05, 0.95  # range of merged opacities, so that they keep a gradient
CELL_GROWTH = 2**0.5  # factor by which cells grow until few enough Gaussians are left


def merge_cells(gaussians: Gaussians, cells: Float[Tensor, "N"]) -> Gaussians:
    """Merge the Gaussians of each cubic cell into their mean, weighted by opacity.

    The merged Gaussian has the opacity of all of them one behind the other, clamped to MIN_OPACITY
    and MAX_OPACITY, and is at least as large as its cell. The sides of the `cells`, > 0, in scene
    units, are rounded to powers of 2, so that cells of one size tile the space, from the minimum
    corner of all means.
    """
    cell, count = _cell_ids(gaussians.means, cells)
    weights = gaussians.opacities.clamp_min(1e-6)  # transparent Gaussians have a mean, too
    total = weights.new_zeros(count).index_add_(0, cell, weights)

    def mean(values: Tensor) -> Tensor:
        shape = (-1, *[1] * (values.ndim - 1))
        summed = values.new_zeros(count, *values.shape[1:])
        return summed.index_add_(0, cell, values * weights.view(shape)) / total.view(shape)

    log_transmittance = torch.log1p(-gaussians.opacities.clamp(max=0.999))
    opacities = 1 - weights.new_zeros(count).index_add_(0, cell, log_transmittance).exp()
    # q and -q are the same rotation: flip all quaternions of a cell to the side of its first.
    rows = torch.arange(len(cell), device=cell.device)
    first = rows.new_full((count,), len(cell)).scatter_reduce_(0, cell, rows, "amin")[cell]
    quats = F.normalize(gaussians.quats, dim=-1)
    opposite = (quats * quats[first]).sum(-1, keepdim=True) < 0
    scales = mean(gaussians.scales.log()).exp()
    return Gaussians(
        means=mean(gaussians.means),
        quats=F.normalize(mean(torch.where(opposite, -quats, quats)), dim=-1),
        scales=torch.maximum(scales, SPREAD * mean(cells.log()).exp()[:, None]),
        opacities=opacities.clamp(MIN_OPACITY, MAX_OPACITY),
        sh=mean(gaussians.sh),
    )


def merge_to_limit(
    gaussians: Gaussians, cameras: Cameras, pixels: float, max_gaussians: int
) -> Gaussians:
    """Merge Gaussians in cells of `pixels`, then larger ones until few enough are left.

    `pixels`, > 0, is the side of a cell in pixels of the view where these are smallest.
    """
    gaussians.validate("merge_to_limit's gaussians")
    cells = pixels * footprints(gaussians.means, cameras)
    extent = (gaussians.means.amax(0) - gaussians.means.amin(0)).max()
    largest = torch.maximum(2 * extent, cells.max())  # one cell holds all means
    while _cell_ids(gaussians.means, cells)[1] > max_gaussians and cells.min() < largest:
        cells = torch.minimum(CELL_GROWTH * cells, largest)
    return merge_cells(gaussians, cells)


def _cell_ids(
    means: Float[Tensor, "N 3"], cells: Float[Tensor, "N"]
) -> tuple[Int[Tensor, "N"], int]:
    """Return the id of each mean's cell, from 0, and the number of cells."""
    level, means = to_float64(cells).log2().round(), to_float64(means)
    offsets = means - means.amin(0)
    position = (offsets / (2**level)[:, None]).floor()
    ids, count = _ranks(level)
    for axis in position.unbind(-1):
        # By ranks, as three positions may not fit into one integer.
        along, length = _ranks(axis)
        ids, count = _ranks(ids * length + along)
    return ids, count


def _ranks(values: Tensor) -> tuple[Int[Tensor, "N"], int]:
    unique, ranks = values.unique(return_inverse=True)
    return ranks, len(unique)
