"""Smooth edges: several rays a pixel where two surfaces meet (adaptive multisampling).

The rays only tell which surface they meet; its color is that of the nearest pixel that shows it.
"""

import torch
from jaxtyping import Float, Int
from torch import Tensor

# A rotated grid: an edge at any angle is met by the four rays one after the other.
SAMPLES = ((-0.125, -0.375), (0.375, -0.125), (-0.375, 0.125), (0.125, 0.375))
# From a pixel to itself and its neighbors (x, y).
NEIGHBORS = ((0, 0), (0, -1), (-1, 0), (1, 0), (0, 1))


def edge_pixels(surfaces: Int[Tensor, "H W"]) -> Int[Tensor, " E"]:
    """Return the numbers, row by row, of pixels beside or above one of another surface."""
    edges = torch.zeros_like(surfaces, dtype=torch.bool)
    beside, above = surfaces[:, 1:] != surfaces[:, :-1], surfaces[1:] != surfaces[:-1]
    edges[:, 1:] |= beside
    edges[:, :-1] |= beside
    edges[1:] |= above
    edges[:-1] |= above
    return edges.flatten().nonzero()[:, 0]


def samples(directions: Float[Tensor, "3 E"], pixel: float) -> Float[Tensor, "3 SE"]:
    """Return directions around those of pixel centers, all of one sample after those of another.

    Args:
        directions: in camera axes, with z = 1.
        pixel: width of a pixel at z = 1.
    """
    offsets = pixel * torch.tensor(SAMPLES, device=directions.device).T[..., None]
    x, y, z = directions[:, None].expand(-1, len(SAMPLES), -1)
    return torch.stack((x + offsets[0], y + offsets[1], z)).flatten(1)


def mixed(
    light: Float[Tensor, "3 HW"],
    surfaces: Int[Tensor, "H W"],
    pixels: Int[Tensor, " E"],
    seen: Int[Tensor, " SE"],
) -> Float[Tensor, "3 E"]:
    """Average over the samples of each pixel the light of the surfaces that they meet.

    A surface that none of them shows counts as the pixel's own.

    Args:
        light, surfaces: of every pixel's center.
        pixels: numbers, row by row.
        seen: surface that each ray of `samples` meets.
    """
    height, width = surfaces.shape
    x, y = torch.tensor(NEIGHBORS, device=pixels.device).T[..., None]
    around = ((pixels // width + y).clamp(0, height - 1)) * width
    around += (pixels % width + x).clamp(0, width - 1)
    shown = surfaces.flatten()[around]
    seen = seen.view(len(SAMPLES), -1)
    # Of the neighbors that show the surface, the first has the largest countdown.
    countdown = torch.arange(len(NEIGHBORS), 0, -1, device=pixels.device)[:, None, None]
    latest = torch.where(shown[:, None] == seen, countdown, 0).amax(0)
    first = (len(NEIGHBORS) - latest) % len(NEIGHBORS)
    return light[:, around.gather(0, first)].mean(1)
