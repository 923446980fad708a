"""What views say of each other's depths: confidence, and depths where there is none."""

from dataclasses import dataclass
from typing import NamedTuple

import torch
import torch.nn.functional as F
from jaxtyping import Float, Int
from torch import Tensor

from asysplat.ops.plane_sweep.cameras import FRONT, relative_projections
from asysplat.scene import Cameras

TOLERANCE = 0.01  # of an inverse depth, or half a step if that is more: two views agree
CONTRADICTION = 2.0  # a trusted view that sees through a point takes two thirds of its confidence
PLACES = 2**20  # that are compared at a time
AROUND = 0.05  # weight of what lies around a pixel against its own depth, fully trusted


@dataclass(frozen=True)
class Depths:
    """Inverse depths of every view, and the step between those that it can tell apart."""

    inverse: Float[Tensor, "B V h w"]
    step: Float[Tensor, "B V"]

    def precision(self) -> Float[Tensor, "B V h w"]:
        """Return how well a depth is told from others, in [0, 1]; 0 at infinity."""
        squared = self.inverse**2
        return squared / (squared + self.step[..., None, None] ** 2).clamp_min(1e-30)


class Votes(NamedTuple):
    """How many other views find the same, how many see through it, and in how many it would be."""

    same: Float[Tensor, "B V h w"]
    through: Float[Tensor, "B V h w"]
    within: Float[Tensor, "B V h w"]

    def agreement(self) -> Float[Tensor, "B V h w"]:
        """Return how far the others agree, in [0, 1]: 0 where none does."""
        return (2 * self.same / (self.same + self.through + 1)).clamp_max(1)


def votes(
    found: Depths,
    cameras: Cameras,
    others: Int[Tensor, "B V K"],
    trust: Float[Tensor, "B V h w"] | None = None,
) -> Votes:
    """Ask other views about the point that each pixel sees.

    One that finds another depth in front of it says nothing.

    Args:
        found: in every view.
        cameras: of these maps.
        others: the views that are asked; -1 for none.
        trust: in a view's depths, in [0, 1]: what its vote counts.
    """
    trust = torch.ones_like(found.inverse) if trust is None else trust
    chunk = max(1, PLACES // found.inverse.numel())
    parts = [_votes(found, cameras, few, trust) for few in others.split(chunk, dim=-1)]
    return Votes(*(torch.stack(counts).sum(0) for counts in zip(*parts, strict=True)))


def other_views(views: int, scenes: int, device: torch.device) -> Int[Tensor, "B V K"]:
    """Return the numbers of all views but each itself; of a single view, -1."""
    if views == 1:
        return torch.full((scenes, 1, 1), -1, device=device)
    following = torch.arange(1, views, device=device) + torch.arange(views, device=device)[:, None]
    return (following % views).expand(scenes, -1, -1)


def _votes(
    found: Depths,
    cameras: Cameras,
    others: Int[Tensor, "B V K"],
    trust: Float[Tensor, "B V h w"],
) -> Votes:
    B, _, h, w = found.inverse.shape
    scene = torch.arange(B, device=others.device)[:, None, None]
    view = others.clamp_min(0)
    matrix = relative_projections(cameras, others)
    y, x = torch.meshgrid(
        torch.arange(h, device=others.device) + 0.5,
        torch.arange(w, device=others.device) + 0.5,
        indexing="ij",
    )
    pixels = torch.stack((x, y, torch.ones_like(x))).to(found.inverse)
    flat = torch.einsum("bvkij,jyx->bvkiyx", matrix[..., :3], pixels)
    moved = matrix[..., 3, None, None] * found.inverse[:, :, None, None]
    x, y, z = (flat + moved).unbind(3)
    front = z.clamp_min(FRONT)
    x, y = x / front, y / front
    within = (z > FRONT) & (x > 0) & (x < w) & (y > 0) & (y < h)
    within &= (others >= 0)[..., None, None]
    column, row = x.clamp(0, w - 1).long(), y.clamp(0, h - 1).long()
    place = (scene[..., None, None], view[..., None, None], row, column)
    difference = found.inverse[:, :, None] / front - found.inverse[place]
    half_step = found.step[scene, view][..., None, None] / 2
    tolerance = torch.maximum(half_step, TOLERANCE * found.inverse[place])
    same = within & (difference.abs() <= tolerance)
    through = within & (difference > tolerance)
    weight = trust[place]
    return Votes((same * weight).sum(2), (through * weight).sum(2), within.to(weight).sum(2))


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
