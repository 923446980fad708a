"""Footprints of pixels, and random numbers."""

from collections.abc import Iterator

import torch
from jaxtyping import Float, Int
from torch import Tensor

from asysplat.scene import Cameras


def footprints(points: Float[Tensor, "N 3"], cameras: Cameras) -> Float[Tensor, "N"]:
    """Compute the size of a pixel at each point: the smallest over the views that show the point.

    For a point outside all views, the smallest as if every camera were turned to it.
    """
    focal = cameras.intrinsics[:, 0, 0]
    visible = torch.full_like(points[:, 0], torch.inf)
    outside = visible.clone()
    for view in range(cameras.num_views):
        camera = cameras.select([view])
        _, depth, inside = camera.project(points)
        size = depth[0] / focal[view]
        visible = torch.minimum(visible, size.where(inside[0], torch.inf))
        outside = torch.minimum(outside, (points - camera.centers).norm(dim=-1) / focal[view])
    sizes = torch.where(visible.isfinite(), visible, outside)
    return sizes.clamp_min(torch.finfo(points.dtype).tiny)


def random_permutation(count: int, generator: torch.Generator) -> Int[Tensor, "count"]:
    """Sample a permutation on the generator's device."""
    return torch.randperm(count, generator=generator, device=generator.device)


def random_order(count: int, generator: torch.Generator) -> Iterator[int]:
    """Yield indices in a random order, without end; all are used before one is used again."""
    while True:
        yield from random_permutation(count, generator).tolist()


def random_normal(
    rows: int, columns: int, generator: torch.Generator
) -> Float[Tensor, "rows columns"]:
    """Sample standard normal numbers on the generator's device."""
    return torch.randn(rows, columns, generator=generator, device=generator.device)
