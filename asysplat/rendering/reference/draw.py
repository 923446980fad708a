"""Project, sort into tiles, composite."""

import torch
from torch import Tensor

from asysplat.rendering.layers import Layers
from asysplat.rendering.reference import compositing
from asysplat.rendering.reference.projection import Splats, project
from asysplat.rendering.reference.tiles import assign_tiles
from asysplat.rendering.settings import Settings
from asysplat.scene import Cameras, Gaussians


def draw(
    gaussians: Gaussians, cameras: Cameras, settings: Settings, masks: Tensor | None = None
) -> Layers:
    """Gaussians [B, N] and cameras [B, V], of one float type, to layers of B V images.

    It takes none of `settings.skips`, and so draws masked pixels too.
    """
    splats = project(gaussians, cameras, settings)
    images = cameras.intrinsics.shape[0] * cameras.num_views
    size = (cameras.height, cameras.width)
    lists = assign_tiles(splats, images, *size, compositing.TILE_SIZE)
    values = _values(splats, settings.depth is not None)
    tiles = compositing.rasterize(
        splats, values, lists, settings.convention, settings.depth == "median"
    )
    out = lists.untile(tiles, *size)
    return Layers(
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
    """[M, 4 or 5]: the colour; 1, which composites to alpha; and the depth."""
    depths = (splats.depths[:, None],) if depth else ()
    return torch.cat((splats.colors, torch.ones_like(splats.colors[:, :1]), *depths), -1)
