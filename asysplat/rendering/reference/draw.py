"""Run the passes of the reference renderer: project, list tiles, rasterize."""

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from asysplat.rendering.interface import RenderOutputs, RenderSettings
from asysplat.rendering.reference import rasterize as raster
from asysplat.rendering.reference.project import project
from asysplat.rendering.reference.rasterize import rasterize
from asysplat.rendering.reference.tiles import list_tiles
from asysplat.scene import Cameras, Gaussians


def draw(
    gaussians: Gaussians,
    cameras: Cameras,
    settings: RenderSettings,
    masks: Bool[Tensor, "B V H W"] | None = None,
    centers: Float[Tensor, "B V N 2"] | None = None,
) -> RenderOutputs:
    """Draw Gaussians [B, N] for cameras [B, V]: B V images, all of one float type.

    Ignores `settings.culling`, and so draws masked pixels too. `centers` receives the gradients of
    the centers.
    """
    splats = project(gaussians, cameras, settings, centers)
    images = cameras.intrinsics.shape[0] * cameras.num_views
    size = (cameras.height, cameras.width)
    lists = list_tiles(splats, images, *size, raster.TILE)
    # Values 1 composite to alpha.
    depths = (splats.depths[:, None],) if settings.depth else ()
    values = torch.cat((splats.colors, torch.ones_like(splats.colors[:, :1]), *depths), -1)
    median = settings.depth == "median"
    tiles = rasterize(splats, values, lists, settings.limits, median)
    out = lists.to_images(tiles, *size)
    return RenderOutputs(
        image=out[:, :3],
        alpha=out[:, 3],
        transmittance=1 - out[:, 3],
        depth=out[:, 4] if settings.depth else None,
        stats={"visible": len(splats.images), "pairs": len(lists.splats), "tile_size": lists.size},
    )
