"""A scene as the viewer shows it, from any camera: colors, depths, alphas or errors."""

from dataclasses import dataclass, replace

import numpy as np
import torch
from jaxtyping import Float, UInt8
from matplotlib import colormaps
from numpy import ndarray
from torch import Tensor
from torch.nn.functional import grid_sample, interpolate

from asysplat.evaluation.figures import ERROR_RANGE, disparity
from asysplat.rendering import render
from asysplat.scene import Cameras, Gaussians, Views

LAYERS = ("color", "depth", "alpha", "error")
THUMBNAIL = 96  # longer side, in pixels
SAMPLED = 10_000  # pixels from which the range of depths is found


@dataclass(frozen=True)
class Look:
    """Which layer of a scene is drawn, and from what of its Gaussians.

    Args:
        layer: "color"; "depth": its inverse, the nearest bright; "alpha"; or "error": how far the
            color is from a photograph's, black where nothing was photographed.
        sh_degree: SH of higher degrees are left out.
        least_opacity: Gaussians of lower opacity are left out.
        size: factor of the scales, > 0.
    """

    layer: str = "color"
    sh_degree: int = 3
    least_opacity: float = 0.0
    size: float = 1.0


@torch.no_grad()
def draw(
    gaussians: Gaussians, camera: Cameras, look: Look, photograph: Tensor | None = None
) -> UInt8[ndarray, "H W 3"]:
    """Render one layer of a scene, as colors.

    Args:
        gaussians: [N].
        camera: one view.
        photograph: RGB [3, H, W] in [0, 1] that the camera should see, NaN where that is unknown;
            without one the layer "error" shows the color.
    """
    opacities = gaussians.opacities
    shown = replace(
        gaussians,
        scales=look.size * gaussians.scales,
        opacities=opacities.where(opacities >= look.least_opacity, 0),
    )
    with_depth = look.layer == "depth"
    rendering = render(shown, camera, depth=with_depth, sh_degree=look.sh_degree)
    image, alpha = rendering.image[0].clamp(0, 1), rendering.alpha[0]
    if with_depth:
        near = disparity(rendering.depth[0])
        sample = near.flatten()[:: 1 + near.numel() // SAMPLED]
        return _mapped(near / sample.quantile(0.99).clamp_min(1e-12), "viridis")
    if look.layer == "alpha":
        image = alpha.expand(3, -1, -1)
    elif look.layer == "error" and photograph is not None:
        error = (image - photograph.to(image)).abs().mean(0)
        return _mapped(error.nan_to_num() / ERROR_RANGE, "magma")
    return _bytes(image)


def _mapped(values: Float[Tensor, "H W"], name: str) -> UInt8[ndarray, "H W 3"]:
    """Give values in [0, 1] the colors of a matplotlib map; what is above has the last one."""
    colors = colormaps[name](np.arange(256), bytes=True)[:, :3]
    return colors[(255 * values.clamp(0, 1)).round().byte().cpu().numpy()]


def photograph_at(
    views: Views, camera: Cameras, within: float
) -> Float[Tensor, "3 {camera.height} {camera.width}"] | None:
    """Return what the camera should see, by a photograph that was taken from where it stands.

    Two cameras in one place see along the same rays, so that this needs no depth. Pixels are NaN
    where they lie outside the photograph or its mask.

    Args:
        views: [V].
        camera: one view.
        within: the distance of two cameras that stand in one place, in scene units.

    Returns:
        None where no photograph was taken; of several the one that looks most the same way.
    """
    apart = (views.cameras.centers - camera.centers).norm(dim=-1)
    here = (apart <= within).nonzero()[:, 0]
    if len(here) == 0:
        return None
    forward = views.cameras.cam_to_world[here, :3, 2] @ camera.cam_to_world[0, :3, 2]
    taken = views.select(here[forward.argmax()][None])
    directions = camera.rays()[1] @ taken.cameras.cam_to_world[0, :3, :3]
    x, y, z = (directions @ taken.cameras.intrinsics[0].mT).unbind(-1)
    place = torch.stack((x / z / taken.cameras.width, y / z / taken.cameras.height), -1) * 2 - 1
    colors = grid_sample(taken.images, place, padding_mode="border", align_corners=False)[0]
    known = ((z > 0) & (place.abs() <= 1).all(-1))[0]
    if taken.masks is not None:
        counts = grid_sample(
            taken.masks[None].to(place), place, mode="nearest", align_corners=False
        )
        known = known & (counts[0, 0] > 0)
    return colors.where(known, torch.nan)


def thumbnail(image: Float[Tensor, "3 H W"]) -> UInt8[ndarray, "h w 3"]:
    """Return an RGB image in [0, 1] as bytes, no larger than a frustum needs it."""
    factor = min(1, THUMBNAIL / max(image.shape[1:]))
    size = [max(round(factor * side), 1) for side in image.shape[1:]]
    return _bytes(interpolate(image[None], size, mode="area")[0])


def _bytes(image: Float[Tensor, "3 H W"]) -> UInt8[ndarray, "H W 3"]:
    return (255 * image).round().byte().permute(1, 2, 0).cpu().numpy()
