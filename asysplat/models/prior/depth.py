"""Priors from depths that come with the data: depth maps, and sparse points."""

import torch
import torch.nn.functional as F
from jaxtyping import Float
from torch import Tensor, nn

from asysplat.models.prior.prior import Prior
from asysplat.scene import Views

SPREAD = (0, 1, 2, 4)  # blocks around a point; each further radius takes a quarter of confidence


class DepthPrior(nn.Module):
    """The depth maps of the data, if there are any; gaps are filled from their surroundings."""

    def forward(self, views: Views, size: tuple[int, int]) -> Prior:
        inverse, known_fraction = _block_means(views.depths, views, size)
        return Prior.from_depths(inverse, known_fraction, known_fraction, views)


class PointsPrior(nn.Module):
    """The depths of the scene's sparse points, spread to their surroundings.

    The data has points with `data.points=true`; without any, all depths are unknown.
    """

    def forward(self, views: Views, size: tuple[int, int]) -> Prior:
        inverse, known_fraction = _block_means(views.point_depths, views, size)
        known = (known_fraction > 0).to(known_fraction)
        spread = [F.max_pool2d(known, 2 * r + 1, stride=1, padding=r) for r in SPREAD]
        return Prior.from_depths(inverse, known, torch.stack(spread).mean(0), views)


def _block_means(
    depths: Float[Tensor, "B V H W"] | None, views: Views, size: tuple[int, int]
) -> tuple[Float[Tensor, "B V h w"], Float[Tensor, "B V h w"]]:
    """Return the mean inverse depth of each block of pixels, and the fraction of known pixels."""
    if depths is None:
        depths = torch.zeros_like(views.images[:, :, 0])
    known = (depths > 0).to(depths)
    stride = depths.shape[-2] // size[0]
    known_fraction = F.avg_pool2d(known, stride)
    inverse = F.avg_pool2d(known / depths.clamp_min(1e-6), stride) / known_fraction.clamp_min(1e-6)
    return inverse, known_fraction
