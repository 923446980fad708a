"""The visual hull of an object: where no photographs show background."""

import torch
import torch.nn.functional as F
from jaxtyping import Bool, Float
from torch import Tensor

from asysplat.scene import Gaussians, Views

MIN_SEEN = 2  # photographs that show background at a point outside: one may have a wrong mask
SEEN = 0.1  # the same, as a fraction of the photographs that have the point in view
EDGE = 3  # pixels a side, all of background: at edges colors are mixed


def is_outside(points: Float[Tensor, "N 3"], views: Views) -> Bool[Tensor, "N"]:
    """Return whether several photographs, with alphas, show background at each point."""
    assert views.alphas is not None
    empty, seen = torch.zeros(2, len(points), device=points.device)
    opaque = F.max_pool2d((views.alphas > 0).to(empty), EDGE, stride=1, padding=EDGE // 2)
    for view in range(views.num_views):
        (pixels,), _, (inside,) = views.cameras.select([view]).project(points)
        column, row = pixels[inside].long().unbind(-1)
        empty[inside] += 1 - opaque[view, row, column]
        seen[inside] += 1
    return empty >= (SEEN * seen).clamp_min(MIN_SEEN)


def within_hull(gaussians: Gaussians, views: Views) -> Gaussians:
    """Return the Gaussians whose centers are not outside; all if none is within."""
    inside = ~is_outside(gaussians.means, views)
    return gaussians.keep(inside) if inside.any() else gaussians
