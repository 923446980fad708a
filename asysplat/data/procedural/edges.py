"""Antialiased edges: several rays a pixel where two surfaces meet (adaptive multisampling).

These rays only find which surface they hit; its color is taken from the nearest pixel showing it.
"""

import torch
from jaxtyping import Float, Int
from torch import Tensor

# A rotated grid: an edge at any angle crosses the four rays one after the other.
SAMPLES = ((-0.125, -0.375), (0.375, -0.125), (-0.375, 0.125), (0.125, 0.375))
# Offsets (x, y) from a pixel to itself and its neighbors.
NEIGHBORS = ((0, 0), (0, -1), (-1, 0), (1, 0), (0, 1))


def edge_pixels(surfaces: Int[Tensor, "H W"]) -> Int[Tensor, " E"]:
    """Return the flat indices of pixels beside, above or below a pixel of another surface."""
    edges = torch.zeros_like(surfaces, dtype=torch.bool)
    beside, above = surfaces[:, 1:] != surfaces[:, :-1], surfaces[1:] != surfaces[:-1]
    edges[:, 1:] |= beside
    edges[:, :-1] |= beside
    edges[1:] |= above
    edges[:-1] |= above
    return edges.flatten().nonzero()[:, 0]


def sample_directions(directions: Float[Tensor, "3 E"], pixel: float) -> Float[Tensor, "3 SE"]:
    """Return SAMPLES directions around each pixel center's, sample by sample, in camera axes.

    Directions have z = 1, where `pixel` is the width of a pixel.
    """
    offsets = pixel * torch.tensor(SAMPLES, device=directions.device).T[..., None]
    x, y, z = directions[:, None].expand(-1, len(SAMPLES), -1)
    return torch.stack((x + offsets[0], y + offsets[1], z)).flatten(1)


def average_samples(
    colors: Float[Tensor, "3 HW"],
    surfaces: Int[Tensor, "H W"],
    pixels: Int[Tensor, " E"],
    sampled: Int[Tensor, " SE"],
) -> Float[Tensor, "3 E"]:
    """Average the colors of the surfaces `sampled` by the rays of `sample_directions`.

    A surface that no neighboring pixel shows is replaced by the pixel's own.
    """
    height, width = surfaces.shape
    x, y = torch.tensor(NEIGHBORS, device=pixels.device).T[..., None]
    around = ((pixels // width + y).clamp(0, height - 1)) * width
    around += (pixels % width + x).clamp(0, width - 1)
    shown = surfaces.flatten()[around]
    sampled = sampled.view(len(SAMPLES), -1)
    # The first neighbor that shows the surface has the largest countdown.
    countdown = torch.arange(len(NEIGHBORS), 0, -1, device=pixels.device)[:, None, None]
    latest = torch.where(shown[:, None] == sampled, countdown, 0).amax(0)
    first = (len(NEIGHBORS) - latest) % len(NEIGHBORS)
    return colors[:, around.gather(0, first)].mean(1)
