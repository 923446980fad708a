"""The layers of the viewer: color, depth, alpha or error, rendered from any camera."""

from dataclasses import replace

import numpy as np
import torch
from jaxtyping import Float, UInt8
from matplotlib import colormaps
from numpy import ndarray
from torch import Tensor
from torch.nn.functional import grid_sample, interpolate

from asysplat.evaluation.figures import MAX_ERROR, disparity
from asysplat.rendering import render
from asysplat.scene import Cameras, Gaussians, Views

LAYERS = ("color", "depth", "alpha", "error")
THUMBNAIL_SIDE = 96  # pixels
MAX_SAMPLES = 10_000  # pixels from which the range of disparities is computed


@torch.no_grad()
def draw_layer(
    gaussians: Gaussians,
    camera: Cameras,
    layer: str = "color",
    sh_degree: int = 3,
    min_opacity: float = 0.0,
    size: float = 1.0,
    target: Float[Tensor, "3 H W"] | None = None,
) -> UInt8[ndarray, "H W 3"]:
    """Render one layer of a scene, as colors.

    Args:
        gaussians: [N].
        camera: one view.
        layer: "color"; "depth": disparities, the nearest bright; "alpha"; or "error": the absolute
            error of the color, black where the target is NaN.
        sh_degree: maximum degree of SH.
        min_opacity: Gaussians below it are left out.
        size: factor of the scales, > 0.
        target: RGB in [0, 1], NaN where unknown; without it "error" shows the color.
    """
    opacities = gaussians.opacities
    gaussians = replace(
        gaussians,
        scales=size * gaussians.scales,
        opacities=opacities.where(opacities >= min_opacity, 0),
    )
    rendering = render(gaussians, camera, depth=layer == "depth", sh_degree=sh_degree)
    image, alpha = rendering.image[0].clamp(0, 1), rendering.alpha[0]
    if layer == "depth":
        values = disparity(rendering.depth[0])
        sample = values.flatten()[:: 1 + values.numel() // MAX_SAMPLES]
        return _colored(values / sample.quantile(0.99).clamp_min(1e-12), "viridis")
    if layer == "error" and target is not None:
        error = (image - target.to(image)).abs().mean(0)
        return _colored(error.nan_to_num() / MAX_ERROR, "magma")
    return _bytes(alpha.expand(3, -1, -1) if layer == "alpha" else image)


def _colored(values: Float[Tensor, "H W"], name: str) -> UInt8[ndarray, "H W 3"]:
    """Map values, clamped to [0, 1], to colors of matplotlib."""
    colors = colormaps[name](np.arange(256), bytes=True)[:, :3]
    return colors[(255 * values.clamp(0, 1)).round().byte().cpu().numpy()]


def image_at(
    views: Views, camera: Cameras, max_distance: float
) -> Float[Tensor, "3 {camera.height} {camera.width}"] | None:
    """Warp the input image taken at a camera's position to that camera.

    Cameras at one position share their rays, so that this needs no depth. Pixels outside the image
    or its mask are NaN.

    Args:
        views: [V].
        camera: one view.
        max_distance: of two cameras at one position, in scene units.

    Returns:
        None where no image was taken; of several the one with the most similar direction.
    """
    distances = (views.cameras.centers - camera.centers).norm(dim=-1)
    near = (distances <= max_distance).nonzero()[:, 0]
    if len(near) == 0:
        return None
    cosines = views.cameras.cam_to_world[near, :3, 2] @ camera.cam_to_world[0, :3, 2]
    view = views.select(near[cosines.argmax()][None])
    directions = camera.rays()[1] @ view.cameras.cam_to_world[0, :3, :3]
    x, y, z = (directions @ view.cameras.intrinsics[0].mT).unbind(-1)
    grid = torch.stack((x / z / view.cameras.width, y / z / view.cameras.height), -1) * 2 - 1
    colors = grid_sample(view.images, grid, padding_mode="border", align_corners=False)[0]
    valid = ((z > 0) & (grid.abs() <= 1).all(-1))[0]
    if view.masks is not None:
        masks = view.masks[None].to(grid)
        valid &= grid_sample(masks, grid, mode="nearest", align_corners=False)[0, 0] > 0
    return colors.where(valid, torch.nan)


def thumbnail(image: Float[Tensor, "3 H W"]) -> UInt8[ndarray, "h w 3"]:
    """Shrink an RGB image in [0, 1] to at most THUMBNAIL_SIDE pixels a side."""
    factor = min(1, THUMBNAIL_SIDE / max(image.shape[1:]))
    size = [max(round(factor * side), 1) for side in image.shape[1:]]
    return _bytes(interpolate(image[None], size, mode="area")[0])


def _bytes(image: Float[Tensor, "3 H W"]) -> UInt8[ndarray, "H W 3"]:
    return (255 * image).round().byte().permute(1, 2, 0).cpu().numpy()
