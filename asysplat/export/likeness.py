"""How alike the pictures of two scenes are."""

import torch
from jaxtyping import Float
from torch import Tensor

from asysplat.evaluation.metrics import psnr
from asysplat.rendering import render
from asysplat.scene import Cameras, Gaussians

COMPARED_VIEWS = 8


@torch.no_grad()
def picture_psnr(
    before: Gaussians, after: Gaussians, cameras: Cameras, background: Float[Tensor, "3"] | None
) -> float:
    """Compute the mean PSNR of one scene's pictures against another's, at up to 8 cameras."""
    count = min(COMPARED_VIEWS, cameras.num_views)
    values = []
    for view in torch.linspace(0, cameras.num_views - 1, count).round().long().tolist():
        camera = cameras.select([view])
        images = [render(g, camera, background, depth=False).image for g in (after, before)]
        values.append(psnr(*(image.clamp(0, 1) for image in images)).mean().item())
    return sum(values) / count
