"""How alike the pictures of two scenes are."""

import torch

from asysplat.evaluation.metrics import psnr
from asysplat.export.gaussians import Notes
from asysplat.rendering import render
from asysplat.scene import Cameras, Gaussians

COMPARED_VIEWS = 8


@torch.no_grad()
def picture_psnr(before: Gaussians, after: Gaussians, cameras: Cameras, notes: Notes) -> float:
    """Compute the mean PSNR of one scene's pictures against another's, at up to 8 cameras."""
    background = torch.tensor(notes.background) if notes.background else None
    count = min(COMPARED_VIEWS, cameras.num_views)
    values = []
    for view in torch.linspace(0, cameras.num_views - 1, count).round().long().tolist():
        images = [
            render(
                *(scene, cameras.select([view]), background),
                depth=False,
                antialiased=notes.antialiased,
            ).image.clamp(0, 1)
            for scene in (after, before)
        ]
        values.append(psnr(*images).mean().item())
    return sum(values) / count
