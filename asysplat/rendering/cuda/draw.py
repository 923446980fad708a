"""Project, sort into tiles, rasterize."""

from torch import Tensor

from asysplat.errors import InputError
from asysplat.rendering.cuda.projection import project
from asysplat.rendering.cuda.tiles import assign_tiles
from asysplat.rendering.layers import Layers
from asysplat.rendering.settings import Settings
from asysplat.scene import Cameras, Gaussians


def draw(
    gaussians: Gaussians, cameras: Cameras, settings: Settings, masks: Tensor | None = None
) -> Layers:
    """Gaussians [B, N] and cameras [B, V] to layers of B V images, float32.

    Of `settings.skips` it takes extent, ellipse and opaque: it projects all Gaussians, and draws
    whole tiles, masked ones too.

    Raises:
        InputError: Triton is missing; tensors elsewhere than on a GPU, unless Triton interprets
            its kernels (TRITON_INTERPRET=1); more pairs of splat and tile than a list can number.
    """
    try:
        from asysplat.rendering.cuda.rasterize import INTERPRETED, rasterize
    except ImportError as error:
        raise InputError("render's backend 'cuda' needs triton: pip install triton.") from error
    if not (gaussians.means.is_cuda or INTERPRETED):
        raise InputError(
            f"render's backend is 'cuda' and its Gaussians are on {gaussians.means.device}: choose "
            "'auto', or move them with .to('cuda')."
        )
    images, splats = project(gaussians, cameras, settings)
    lists = assign_tiles(
        images,
        splats.detach(),
        cameras.intrinsics.shape[0] * cameras.num_views,
        (cameras.height, cameras.width),
        settings,
    )
    image, alpha, depth, last_entry = rasterize(splats, lists, settings)
    drawn = int((last_entry - lists.first_entry[:-1]).sum())
    stats = {
        "visible": len(splats),
        "pairs": len(lists.entries),
        "pairs_off_ellipse": lists.off_ellipse,
        "pairs_behind_opaque": len(lists.entries) - drawn,
        "tile_size": lists.size,
    }
    return Layers(image, alpha, 1 - alpha, depth, stats)
