"""What views say of each other's depths: confidence, and depths where there is none."""

from dataclasses import dataclass

import torch
import torch.nn.functional as F
from jaxtyping import Float, Int
from torch import Tensor

from asysplat.ops.plane_sweep.cameras import FRONT, relative_projections
from asysplat.scene import Cameras

TOLERANCE = 0.05  # of an inverse depth, or one plane if that is more: two views agree
AROUND = 0.05  # weight of what lies around a pixel against its own depth, fully trusted


@dataclass(frozen=True)
class Depths:
    """Inverse depths of every view and the distance of its planes."""

    inverse: Float[Tensor, "B V h w"]
    step: Float[Tensor, "B V"]

    @classmethod
    def at_planes(
        cls, plane: Float[Tensor, "B V h w"], ranges: Float[Tensor, "B V 2"], planes: int
    ) -> "Depths":
        """Return the inverse depths of places between planes."""
        least, greatest = ranges.unbind(-1)
        step = (greatest - least) / (planes - 1)
        return cls(least[..., None, None] + plane * step[..., None, None], step)

    def precision(self) -> Float[Tensor, "B V h w"]:
        """Return how well the planes tell a depth from others, in [0, 1]; 0 at infinity."""
        squared = self.inverse**2
        return squared / (squared + self.step[..., None, None] ** 2).clamp_min(1e-30)


def compare(
    found: Depths, cameras: Cameras, neighbours: Int[Tensor, "B V K"]
) -> Float[Tensor, "B V h w"]:
    """Return how far the neighbours agree with every depth: in [0, 1], 0 where none does.

    Each neighbour that sees the point agrees, has something in front of it, which says nothing, or
    sees through it, which speaks against it.
    """
    B, _, h, w = found.inverse.shape
    scene = torch.arange(B, device=neighbours.device)[:, None, None]
    view = neighbours.clamp_min(0)
    matrix = relative_projections(cameras, neighbours)
    y, x = torch.meshgrid(
        torch.arange(h, device=neighbours.device) + 0.5,
        torch.arange(w, device=neighbours.device) + 0.5,
        indexing="ij",
    )
    pixels = torch.stack((x, y, torch.ones_like(x))).to(found.inverse)
    flat = torch.einsum("bvkij,jyx->bvkiyx", matrix[..., :3], pixels)
    moved = matrix[..., 3, None, None] * found.inverse[:, :, None, None]
    x, y, z = (flat + moved).unbind(3)
    front = z.clamp_min(FRONT)
    x, y = x / front, y / front
    seen = (z > FRONT) & (x > 0) & (x < w) & (y > 0) & (y < h)
    seen &= (neighbours >= 0)[..., None, None]
    column, row = x.clamp(0, w - 1).long(), y.clamp(0, h - 1).long()
    there = found.inverse[scene[..., None, None], view[..., None, None], row, column]
    difference = found.inverse[:, :, None] / front - there
    tolerance = torch.maximum(found.step[scene, view][..., None, None], TOLERANCE * there)
    agree = (seen & (difference.abs() <= tolerance)).sum(2)
    against = (seen & (difference > tolerance)).sum(2)
    return (2 * agree / (agree + against + 1)).clamp_max(1).to(found.inverse)


def fill(
    inverse: Float[Tensor, "B V h w"], trust: Float[Tensor, "B V h w"]
) -> Float[Tensor, "B V h w"]:
    """Replace what is uncertain by what lies around it, the nearer the more; 0 if nothing is known.

    A pyramid of weighted means from the whole scene's down to each pixel's.

    Args:
        inverse: inverse depths.
        trust: in [0, 1], squared for a pixel's weight.
    """
    weights, sums = [trust**2], [trust**2 * inverse]
    while max(weights[-1].shape[-2:]) > 1:
        for maps in (weights, sums):
            maps.append(F.avg_pool2d(maps[-1], 2, ceil_mode=True))
    scene = sums[-1].sum(1, keepdim=True) / weights[-1].sum(1, keepdim=True).clamp_min(1e-12)
    filled = scene.expand_as(weights[-1])
    for weight, total in zip(reversed(weights), reversed(sums), strict=True):
        around = F.interpolate(filled, weight.shape[-2:], mode="bilinear")
        filled = (total + AROUND * around) / (weight + AROUND)
    return filled
