"""Which Gaussians pictures need, and how like the pictures of a written file are."""

from dataclasses import replace

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from asysplat.evaluation.metrics import psnr
from asysplat.export.gaussians import Notes
from asysplat.geometry.spherical_harmonics import SH_C0
from asysplat.rendering import render
from asysplat.scene import Cameras, Gaussians, Views

SEEN = 0.2  # least sum of blending weights, in pixels: below .05 are 10 %, below .5 33 % of all


def blending_weights(
    gaussians: Gaussians, cameras: Cameras, masks: Bool[Tensor, "V H W"] | None = None
) -> Float[Tensor, "N"]:
    """Compute the sum of each Gaussian's blending weights over all pixels that count."""
    # An image is linear in the Gaussians' colors, with these weights as its gradient.
    gray = torch.zeros_like(gaussians.sh[:, :1], requires_grad=True)
    with torch.enable_grad():
        for view in range(cameras.num_views):
            scene = replace(gaussians, sh=gray)
            of_view = None if masks is None else masks[view : view + 1]
            image = render(scene, cameras.select([view]), depth=False, masks=of_view).image[:, 0]
            image.backward(torch.ones_like(image) if of_view is None else of_view.to(image))
    return gray.grad[:, 0, 0] / SH_C0


def without_unseen(gaussians: Gaussians, views: Views) -> Gaussians:
    """Leave out the Gaussians that no input shows, whose colors are guesses; all: leave out none.

    Where nothing else is, other views then show the background.
    """
    seen = blending_weights(gaussians, views.cameras, views.masks) >= SEEN
    return gaussians.keep(seen) if seen.any() else gaussians


def most_important(gaussians: Gaussians, fraction: float, cameras: Cameras | None) -> Gaussians:
    """Keep the Gaussians of largest blending weights, or opacity times area, in their order."""
    if cameras is None:
        weights = gaussians.opacities * gaussians.scales.sort(-1).values[:, 1:].prod(-1)
    else:
        weights = blending_weights(gaussians, cameras)
    count = max(1, round(fraction * gaussians.num_gaussians))
    kept = torch.zeros_like(weights, dtype=torch.bool)
    kept[weights.argsort(descending=True, stable=True)[:count]] = True
    return gaussians.keep(kept)


COMPARED_VIEWS = 8


@torch.no_grad()
def picture_psnr(before: Gaussians, after: Gaussians, cameras: Cameras, notes: Notes) -> float:
    """Compute the mean PSNR of one scene's pictures against another's, at up to 8 cameras."""
    background = torch.tensor(notes.background) if notes.background else None
    options = {"depth": False, "antialiased": notes.antialiased}
    count = min(COMPARED_VIEWS, cameras.num_views)
    values = []
    for view in torch.linspace(0, cameras.num_views - 1, count).round().long().tolist():
        camera, scenes = cameras.select([view]), (after, before)
        images = (render(scene, camera, background, **options).image for scene in scenes)
        values.append(psnr(*(image.clamp(0, 1) for image in images)).mean().item())
    return sum(values) / count
