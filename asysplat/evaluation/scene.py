"""Measure how well Gaussians show the images of a scene, view by view."""

import torch
from jaxtyping import Float
from lpips import LPIPS
from torch import Tensor

from asysplat.evaluation.protocol import Protocol
from asysplat.rendering import render
from asysplat.scene import Gaussians, Views


@torch.no_grad()
def measure_scene(
    gaussians: Gaussians,
    views: Views,
    background: Float[Tensor, "3"],
    protocol: Protocol,
    lpips: LPIPS | None = None,
) -> dict[str, list[float]]:
    """Render each of [V] views and compute all metrics of the protocol: name -> a number a view."""
    metrics: dict[str, list[float]] = {}
    for view in range(views.num_views):
        target = views.select([view])
        out = render(gaussians, target.cameras, background)
        values = protocol.image_metrics(out.image, target, lpips)
        values |= protocol.depth_metrics(out.depth, target)
        for name, value in values.items():
            metrics.setdefault(name, []).append(value.item())
    return metrics
