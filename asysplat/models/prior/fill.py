"""Inverse depths where nothing can be matched: planes continued from what is known around.

The inverse depth of a plane is linear in a pixel's coordinates. Each pixel gets the plane that fits
the known inverse depths around it best (moving least squares), where a change of color between the
two counts as a distance: planes end at the edges of what they belong to.
"""

import torch
import torch.nn.functional as F
from jaxtyping import Float
from torch import Tensor

from asysplat.ops.plane_sweep import load_backend

RADIUS = 16.0  # pixels over which a known depth's weight falls to 1 / e
COLOR_CHANGE = 0.025  # color difference between adjacent pixels that lowers it as much
OUTLIER = 0.1  # relative difference from a first fit that halves a weight in the second
SLANT = 1e-3  # variance of positions, in image sides, that is added: a spot fits any slant
BOUND = 2.0  # greatest ratio of a continued inverse depth to the mean of those around
SCENE_WEIGHT = 1e-6  # of the scene's mean, where nothing around is known
SURROUNDINGS_WEIGHT = 0.05  # against the weight 1 of a pixel's own depth at full trust


def fill_unknown(
    inverse: Float[Tensor, "B V h w"],
    trust: Float[Tensor, "B V h w"],
    edges: Float[Tensor, "B V 2 h w"],
    backend: str = "auto",
) -> Float[Tensor, "B V h w"]:
    """Replace uncertain inverse depths by those of planes around them; 0 if none is known.

    Args:
        inverse: any scale.
        trust: in [0, 1].
        edges: see `color_edges`.
        backend: see `plane_sweep`.
    """
    weights = trust**2
    total = weights.sum((1, 2, 3), keepdim=True)
    scene = (weights * inverse).sum((1, 2, 3), keepdim=True) / total.clamp_min(1e-12)
    keep = torch.exp(-1 / RADIUS - edges / COLOR_CHANGE)
    fitted, _ = fit_planes(inverse, weights, keep, backend)
    error = inverse / fitted.clamp_min(1e-30) - 1
    fitted, known = fit_planes(inverse, weights / (1 + (error / OUTLIER) ** 2), keep, backend)
    fitted = (known * fitted + SCENE_WEIGHT * scene) / (known + SCENE_WEIGHT)
    return (weights * inverse + SURROUNDINGS_WEIGHT * fitted) / (weights + SURROUNDINGS_WEIGHT)


def fit_planes(
    inverse: Float[Tensor, "B V h w"],
    weights: Float[Tensor, "B V h w"],
    keep: Float[Tensor, "B V 2 h w"],
    backend: str = "auto",
) -> tuple[Float[Tensor, "B V h w"], Float[Tensor, "B V h w"]]:
    """Return at each pixel the inverse depth of the plane around it, and the sum of the weights.

    `keep` is the factor by which weights fall from a pixel to the next; see `spread`.
    """
    height, width = inverse.shape[-2:]
    x, y = ((torch.arange(side).to(inverse) + 0.5) / max(height, width) for side in (width, height))
    x, y = (x - x.mean()).expand(height, width), (y - y.mean())[:, None].expand(height, width)
    basis = torch.stack((torch.ones_like(x), x, y, x * x, x * y, y * y), dim=-1)
    weights, inverse = weights[..., None], inverse[..., None]
    moments = torch.cat((weights * basis, weights * inverse * basis[..., :3]), dim=-1)
    moments = load_backend(backend, inverse).spread(moments, keep)
    known = moments[..., 0]
    _, mx, my, xx, xy, yy, mean, xd, yd = (moments / known.clamp_min(1e-30)[..., None]).unbind(-1)
    xx, xy, yy = xx - mx * mx + SLANT, xy - mx * my, yy - my * my + SLANT
    xd, yd = xd - mx * mean, yd - my * mean
    slope = (yy * xd - xy * yd) * (x - mx) + (xx * yd - xy * xd) * (y - my)
    fitted = mean + slope / (xx * yy - xy * xy)
    return torch.minimum(torch.maximum(fitted, mean / BOUND), mean * BOUND), known


def color_edges(images: Float[Tensor, "B V 3 H W"]) -> Float[Tensor, "B V 2 H W"]:
    """Return the mean absolute color difference to the left pixel, and to the pixel above."""
    left = F.pad(images.diff(dim=-1).abs().mean(2), (1, 0))
    above = F.pad(images.diff(dim=-2).abs().mean(2), (0, 0, 1, 0))
    return torch.stack((left, above), dim=2)
