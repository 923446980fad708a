"""Depth maps of sparse points."""

import torch
import torch.nn.functional as F
from jaxtyping import Float
from torch import Tensor

from asysplat.data.sequence import Points
from asysplat.scene import Cameras

POINTS_PER_WINDOW = 4  # on average: enough to include a surface that occludes a point
OCCLUSION_MARGIN = 0.2  # a point so much deeper than its window's nearest point is occluded


def depths_of_points(points: Points, cameras: Cameras) -> Float[Tensor, "V H W"]:
    """Render the depth along z of the nearest point in every pixel; 0 without a visible point.

    A point counts as occluded if it is much deeper than another point in a window around it, since
    sparse points of a surface leave gaps. The sparser the points, the larger the window.

    Args:
        points: in the world of the cameras.
        cameras: one scene's cameras, [V].
    """
    exact_points, exact = torch.as_tensor(points, dtype=torch.float64), cameras.to(torch.float64)
    inverse = torch.zeros(cameras.num_views, cameras.height, cameras.width)
    for view, nearest in enumerate(inverse):  # every pixel's greatest inverse depth
        (pixels,), (depth,), (inside,) = exact.select([view]).project(exact_points)
        x, y = pixels[inside].long().unbind(-1)
        index, values = y * cameras.width + x, (1 / depth[inside]).float()
        nearest.view(-1).scatter_reduce_(0, index, values, "amax")
    nearest = torch.stack([_window_maximum(view) for view in inverse])
    visible = (inverse > 0) & (inverse * (1 + OCCLUSION_MARGIN) >= nearest)
    return torch.where(visible, 1 / inverse, 0).to(cameras.intrinsics)


def _window_maximum(inverse: Float[Tensor, "H W"]) -> Float[Tensor, "H W"]:
    """Return the greatest inverse depth in the window of 3 x 3 cells around every pixel's cell."""
    known = (inverse > 0).sum().clamp_min(1).item()
    cell = max(1, round((POINTS_PER_WINDOW * inverse.numel() / known) ** 0.5 / 3))
    cells = F.max_pool2d(inverse[None], cell, ceil_mode=True)
    windows = F.max_pool2d(cells, 3, stride=1, padding=1)[0]
    row, column = (torch.arange(length) // cell for length in inverse.shape)
    return windows[row[:, None], column]
