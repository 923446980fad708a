"""Sparse points of a scene, as its cameras see them."""

import torch
import torch.nn.functional as F
from jaxtyping import Float
from torch import Tensor

from asysplat.data.sequence import Points
from asysplat.scene import Cameras

IN_A_WINDOW = 4  # points, on average: enough to meet the surface that hides a point
BEHIND = 0.2  # of the nearest depth in its window: a point that is farther is hidden


def depths_of_points(points: Points, cameras: Cameras) -> Float[Tensor, "V H W"]:
    """Return the depth along z of the nearest point in every pixel; 0 where there is none.

    Between the points of a surface one sees those behind it. A point that is much farther than
    another in a window around it is therefore left out; the sparser the points, the larger the
    window.

    Args:
        points: in the world of the cameras.
        cameras: of one scene, [V].
    """
    homogeneous = F.pad(torch.as_tensor(points, dtype=torch.float64), (0, 1), value=1.0)
    world_to_cam = torch.linalg.inv(cameras.cam_to_world.double())
    projections = cameras.intrinsics.double() @ world_to_cam[:, :3]
    size = (cameras.height, cameras.width)
    inverse = torch.stack([_nearest(homogeneous @ p.mT, *size) for p in projections])
    seen = (inverse > 0) & (inverse * (1 + BEHIND) >= torch.stack([_around(i) for i in inverse]))
    return torch.where(seen, 1 / inverse, 0).to(cameras.intrinsics)


def _nearest(projected: Float[Tensor, "P 3"], height: int, width: int) -> Float[Tensor, "H W"]:
    """Return the greatest inverse depth in every pixel, from homogeneous image positions."""
    z = projected[:, 2]
    x, y = (projected[:, :2] / z[:, None]).floor().unbind(-1)
    inside = (z > 0) & (x >= 0) & (x < width) & (y >= 0) & (y < height)
    pixel = (y[inside] * width + x[inside]).long()
    inverse = torch.zeros(height * width)
    return inverse.scatter_reduce(0, pixel, (1 / z[inside]).float(), "amax").view(height, width)


def _around(inverse: Float[Tensor, "H W"]) -> Float[Tensor, "H W"]:
    """Return the greatest inverse depth in the window of 3 x 3 cells around every pixel's cell."""
    known = (inverse > 0).sum().clamp_min(1).item()
    cell = max(1, round((IN_A_WINDOW * inverse.numel() / known) ** 0.5 / 3))
    cells = F.max_pool2d(inverse[None], cell, ceil_mode=True)
    windows = F.max_pool2d(cells, 3, stride=1, padding=1)[0]
    row, column = (torch.arange(length) // cell for length in inverse.shape)
    return windows[row[:, None], column]
