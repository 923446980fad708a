"""Which Gaussians pictures need most, and how like the pictures of a written file are."""

from collections.abc import Sequence

import torch
from jaxtyping import Bool
from torch import Tensor

from asysplat.evaluation.metrics import psnr
from asysplat.rendering import blending_weights, render
from asysplat.scene import Cameras, Gaussians


def most_important(
    gaussians: Gaussians, fraction: float, cameras: Cameras | None
) -> Bool[Tensor, "N"]:
    """Return which Gaussians, at least one, have the largest blending weights over the cameras.

    Without cameras, the largest opacity times area.
    """
    if cameras is None:
        weights = gaussians.opacities * gaussians.scales.sort(-1).values[:, 1:].prod(-1)
    else:
        weights = blending_weights(gaussians, cameras)
    count = max(1, round(fraction * gaussians.num_gaussians))
    kept = torch.zeros_like(weights, dtype=torch.bool)
    kept[weights.argsort(descending=True, stable=True)[:count]] = True
    return kept


COMPARED_VIEWS = 8


@torch.no_grad()
def picture_psnr(
    before: Gaussians,
    after: Gaussians,
    cameras: Cameras,
    background: Sequence[float],
    antialiased: bool,
) -> float:
    """Compute the mean PSNR of one scene's pictures against another's, at up to 8 cameras."""
    look = {"background": torch.tensor(background), "antialiased": antialiased, "depth": False}
    count = min(COMPARED_VIEWS, cameras.num_views)
    values = []
    for view in torch.linspace(0, cameras.num_views - 1, count).round().long().tolist():
        camera, scenes = cameras.select([view]), (after, before)
        images = (render(scene, camera, **look).image for scene in scenes)
        values.append(psnr(*(image.clamp(0, 1) for image in images)).mean().item())
    return sum(values) / count
