"""How much each Gaussian adds to the pictures of a scene."""

from dataclasses import replace

import torch
from jaxtyping import Float
from torch import Tensor

from asysplat.geometry.spherical_harmonics import SH_C0
from asysplat.rendering import render
from asysplat.scene import Cameras, Gaussians


def blending_weights(gaussians: Gaussians, cameras: Cameras) -> Float[Tensor, "N"]:
    """Compute the sum of each Gaussian's blending weights over all pixels of all views.

    An image is linear in the Gaussians' colors, with these weights as its gradient.

    Args:
        gaussians: [N].
        cameras: [V]; views are rendered one by one.
    """
    gray = torch.zeros_like(gaussians.sh[:, :1], requires_grad=True)
    with torch.enable_grad():
        for view in range(cameras.num_views):
            scene = replace(gaussians, sh=gray)
            render(scene, cameras.select([view]), depth=False).image[:, 0].sum().backward()
    return gray.grad[:, 0, 0] / SH_C0


def most_important(gaussians: Gaussians, fraction: float, cameras: Cameras | None) -> Gaussians:
    """Keep a fraction of the Gaussians: those with the largest blending weights, in their order.

    Without cameras, opacity times area stands for the weight.
    """
    if cameras is None:
        largest_two = gaussians.scales.sort(-1).values[:, 1:]
        weights = gaussians.opacities * largest_two.prod(-1)
    else:
        weights = blending_weights(gaussians, cameras)
    count = max(1, round(fraction * gaussians.num_gaussians))
    kept = torch.zeros_like(weights, dtype=torch.bool)
    kept[weights.argsort(descending=True, stable=True)[:count]] = True
    return gaussians.keep(kept)
