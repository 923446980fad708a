"""What views say of each other's depths: confidence, and depths where there is none."""

from dataclasses import dataclass

import torch
import torch.nn.functional as F
from jaxtyping import Float, Int
from torch import Tensor

from asysplat.ops.plane_sweep.backends import load
from asysplat.ops.plane_sweep.reference import Votes

CONTRADICTION = 2.0  # a trusted view that sees through a point takes two thirds of its confidence
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


def votes(
    found: Depths,
    others: Int[Tensor, "B V K"],
    projections: Float[Tensor, "B V K 3 4"],
    trust: Float[Tensor, "B V h w"] | None = None,
    backend: str = "auto",
) -> Votes:
    """Ask other views about the point that each pixel sees.

    One that finds another depth in front of it says nothing.

    Args:
        found: in every view.
        others: the views that are asked; -1 for none.
        projections: into those, between maps of this size.
        trust: in a view's depths, in [0, 1]: what its vote counts; 1 if None.
        backend: see `plane_sweep`.
    """
    trust = torch.ones_like(found.inverse) if trust is None else trust
    form = load(backend, found.inverse)
    return form.count_votes(found.inverse, found.step, trust, others, projections)


def other_views(views: int, scenes: int, device: torch.device) -> Int[Tensor, "B V K"]:
    """Return the numbers of all views but each itself; of a single view, -1."""
    if views == 1:
        return torch.full((scenes, 1, 1), -1, device=device)
    following = torch.arange(1, views, device=device) + torch.arange(views, device=device)[:, None]
    return (following % views).expand(scenes, -1, -1)


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
