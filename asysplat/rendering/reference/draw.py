"""The reference renderer, one pass after the other: project, list tiles, rasterize."""

import torch
from torch import Tensor

from asysplat.rendering.interface import RenderOutputs, RenderSettings
from asysplat.rendering.reference import rasterize as raster
from asysplat.rendering.reference.project import Splats, project
from asysplat.rendering.reference.rasterize import rasterize
from asysplat.rendering.reference.tiles import list_tiles
from asysplat.scene import Cameras, Gaussians


def draw(
    gaussians: Gaussians, cameras: Cameras, settings: RenderSettings, masks: Tensor | None = None
) -> RenderOutputs:
    """Draw Gaussians [B, N] for cameras [B, V]: B V images, all of one float type.

    It uses none of `settings.culling`, and so draws masked pixels too.
    """
    splats = project(gaussians, cameras, settings)
    images = cameras.intrinsics.shape[0] * cameras.num_views
    size = (cameras.height, cameras.width)
    lists = list_tiles(splats, images, *size, raster.TILE)
    values = _values(splats, settings.depth is not None)
    median = settings.depth == "median"
    tiles = rasterize(splats, values, lists, settings.convention, median)
    out = lists.to_images(tiles, *size)
    return RenderOutputs(
        image=out[:, :3],
        alpha=out[:, 3],
        transmittance=1 - out[:, 3],
        depth=out[:, 4] if settings.depth else None,
        stats={
            "visible": len(splats.images),
            "pairs": len(lists.splats),
            "tile_size": lists.size,
        },
    )


def _values(splats: Splats, depth: bool) -> Tensor:
    """Return [M, 4 or 5]: the color; 1, which composites to alpha; and the depth."""
    depths = (splats.depths[:, None],) if depth else ()
    return torch.cat((splats.colors, torch.ones_like(splats.colors[:, :1]), *depths), -1)
