"""The renderer's one public function."""

import math
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from asysplat.errors import InputError
from asysplat.ops.dispatch import pick_backend
from asysplat.ops.precision import without_autocast
from asysplat.rendering.projection import Splats, project
from asysplat.rendering.rasterize import reference
from asysplat.rendering.tiles import assign_tiles
from asysplat.scene import Cameras, Gaussians, TensorRecord

BACKENDS = {"auto": reference, "reference": reference}
ALPHA_TINY = 1e-6  # an alpha below 1/255 is exactly 0, so any value between will do


@dataclass(frozen=True)
class Rendering(TensorRecord):
    """What `render` returns, in float32, or in float64 for float64 inputs.

    Args:
        image: [..., V, 3, H, W] >= 0; no upper bound.
        alpha: [..., V, H, W] in [0, 1).
        depth: [..., V, H, W] expected z, in scene units: sum_i w_i z_i / alpha, and 0 where no
            Gaussian is seen. None unless asked for.
        stats: visible (pairs of Gaussian and view), intersections (of those with tiles), tile_size.
    """

    image: Float[Tensor, "*batch V 3 H W"]
    alpha: Float[Tensor, "*batch V H W"]
    depth: Float[Tensor, "*batch V H W"] | None
    stats: dict[str, float | int]


def render(
    gaussians: Gaussians,
    cameras: Cameras,
    background: Tensor | None = None,
    backend: str = "auto",
    depth: bool = True,
) -> Rendering:
    """Render every view, by alpha compositing in depth order (Kerbl et al. 2023).

    Differentiable in all fields of `gaussians` and `cameras`, and in `background`; a Gaussian that
    is culled (see `project`) has gradient 0. Half-precision inputs are computed in float32, also
    under autocast. On a CPU the same inputs give the same bits on any number of threads.

    Args:
        gaussians: [..., N].
        cameras: [..., V], with the batch dimensions of `gaussians`. Skew is ignored.
        background: RGB [3], or [..., V, 3] one a view; None is black.
        backend: "auto" or "reference".
        depth: whether to render the depth.

    Raises:
        InputError: an unknown backend, or shapes that do not fit together.
    """
    rasterizer = pick_backend("render", BACKENDS, backend)
    batch = _check_batch(gaussians, cameras, background)
    dtype = torch.promote_types(gaussians.means.dtype, cameras.cam_to_world.dtype)
    dtype = torch.promote_types(dtype, torch.float32)
    with without_autocast(gaussians.means):
        scenes = gaussians.map(lambda t: _one_batch(t.to(dtype), batch))
        views = cameras.map(lambda t: _one_batch(t.to(dtype), batch))
        splats = project(scenes, views)
        images = views.intrinsics.shape[0] * views.num_views
        lists = assign_tiles(splats, images, cameras.height, cameras.width, rasterizer.TILE_SIZE)
        tiles = rasterizer.rasterize(splats, _values(splats, depth), lists)
        out = lists.untile(tiles, cameras.height, cameras.width)
        out = out.unflatten(0, (*batch, cameras.num_views))
        image, alpha = out[..., :3, :, :], out[..., 3, :, :]
        if background is not None:
            color = background.to(dtype)[..., None, None]
            image = image + (1 - alpha)[..., None, :, :] * color
        stats = {
            "visible": len(splats.images),
            "intersections": len(lists.splats),
            "tile_size": lists.size,
        }
        expected = out[..., 4, :, :] / alpha.clamp_min(ALPHA_TINY) if depth else None
        return Rendering(image, alpha, expected, stats)


def _values(splats: Splats, depth: bool) -> Tensor:
    """[M, 4 or 5]: the colour; 1, which composites to alpha; and the depth."""
    depths = (splats.depths[:, None],) if depth else ()
    return torch.cat((splats.colors, torch.ones_like(splats.colors[:, :1]), *depths), -1)


def _one_batch(tensor: Tensor, batch: tuple[int, ...]) -> Tensor:
    """All batch dimensions as one, which is 1 where there were none."""
    return tensor.reshape(math.prod(batch), *tensor.shape[len(batch) :])


def _check_batch(
    gaussians: Gaussians, cameras: Cameras, background: Tensor | None
) -> tuple[int, ...]:
    """The shared batch dimensions."""
    batch, views = tuple(gaussians.opacities.shape[:-1]), tuple(cameras.intrinsics.shape[:-2])
    if batch != views[:-1]:
        raise InputError(
            f"render's gaussians have the batch dimensions {batch} and its cameras {views[:-1]}: "
            "give both the same."
        )
    if background is not None and tuple(background.shape) not in ((3,), (*views, 3)):
        raise InputError(
            f"render's background has shape {tuple(background.shape)}: "
            f"expected (3,) or {(*views, 3)}."
        )
    return batch
