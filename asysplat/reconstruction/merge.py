"""Merge Gaussians that say the same: many views see one surface."""

import torch
import torch.nn.functional as F
from jaxtyping import Float, Int
from torch import Tensor

from asysplat.reconstruction.start import SPREAD, footprints
from asysplat.scene import Cameras, Gaussians

LEAST_OPACITY, MOST_OPACITY = 0.05, 0.95  # what is merged keeps a gradient
COARSER = 2**0.5  # by which cells grow until few enough Gaussians are left


def merged(gaussians: Gaussians, cells: Float[Tensor, "N"]) -> Gaussians:
    """Merge the Gaussians of each cubic cell: their mean, weighted by opacity.

    Together they hide what all of them hid. What is left covers its cell.

    Args:
        gaussians: [N].
        cells: side of the cell that each is in, in scene units; rounded to a power of 2, so that
            cells of one size tile the space.
    """
    cell = _cell_of(gaussians.means, cells)
    count = int(cell.max()) + 1 if len(cell) else 0
    weights = gaussians.opacities
    total = weights.new_zeros(count).index_add_(0, cell, weights)

    def mean(values: Tensor) -> Tensor:
        shaped = weights.view(-1, *[1] * (values.ndim - 1))
        summed = values.new_zeros(count, *values.shape[1:]).index_add_(0, cell, values * shaped)
        return summed / total.view(-1, *[1] * (values.ndim - 1))

    hidden = torch.log1p(-gaussians.opacities.clamp(max=0.999))
    opacities = 1 - weights.new_zeros(count).index_add_(0, cell, hidden).exp()
    # q and -q are one rotation: all are turned to the half space of the first component.
    quats = F.normalize(gaussians.quats * gaussians.quats[:, :1].sign(), dim=-1)
    scales = mean(gaussians.scales.log()).exp()
    return Gaussians(
        means=mean(gaussians.means),
        quats=mean(quats),
        scales=torch.maximum(scales, SPREAD * mean(cells.log()).exp()[:, None]),
        opacities=opacities.clamp(LEAST_OPACITY, MOST_OPACITY),
        sh=mean(gaussians.sh),
    )


def thinned(gaussians: Gaussians, cameras: Cameras, pixels: float, most: int) -> Gaussians:
    """Merge Gaussians in cells of `pixels`, and of more until at most `most` are left.

    Args:
        gaussians: [N].
        cameras: that see them.
        pixels: side of a cell, in pixels of the camera that sees it closest.
        most: >= 1.
    """
    cells = pixels * footprints(gaussians.means, cameras)
    while True:
        fewer = merged(gaussians, cells)
        if fewer.num_gaussians <= most:
            return fewer
        cells = cells * COARSER


def _cell_of(means: Float[Tensor, "N 3"], cells: Float[Tensor, "N"]) -> Int[Tensor, "N"]:
    """Give each mean the number of its cell, from 0."""
    level = cells.double().log2().round()
    place = (means.double() / (2**level)[:, None]).floor()
    key = torch.cat((place, level[:, None]), dim=-1).long()
    return torch.unique(key, dim=0, return_inverse=True)[1]
