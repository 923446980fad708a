"""Which input views a network looks at: those that see what the others do not."""

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from asysplat.models.early_exit import EarlyExit
from asysplat.models.prior import Prior
from asysplat.scene import Cameras

SAMPLES = 16  # of a view's pixels along a side: what is covered is counted on these
SURE = 0.5  # confidence of a sample that another view may stand for
SAME = 0.1  # relative difference of two distances to one surface


def views_to_look_at(skips: EarlyExit, prior: Prior, cameras: Cameras) -> list[int]:
    """Return the numbers of the views that a network has to look at, ascending; perhaps none.

    Args:
        skips: of which `known` and `coverage` count.
        prior, cameras: of one scene, [1, V].
    """
    if skips.known is not None and prior.confidence.mean() >= skips.known:
        return []
    if skips.coverage is None:
        return list(range(cameras.num_views))
    return covering_views(prior, cameras, skips.coverage)


def covering_views(prior: Prior, cameras: Cameras, share: float) -> list[int]:
    """Choose views, each time that which sees most of what those before it do not.

    Args:
        prior: of one scene, [1, V].
        cameras: [1, V].
        share: of all samples, which the chosen views see together, in (0, 1].

    Returns:
        Their numbers, ascending; at least one.
    """
    sees = seen_samples(prior, cameras)
    unseen = torch.ones_like(sees[0])
    chosen: list[int] = []
    while not chosen or unseen.sum() > (1 - share) * len(unseen):
        chosen.append(int((sees & unseen).sum(1).argmax()))
        unseen &= ~sees[chosen[-1]]
    return sorted(chosen)


def seen_samples(prior: Prior, cameras: Cameras) -> Bool[Tensor, "V N"]:
    """Tell which view sees which samples of all views' surfaces, by the prior's distances.

    A view sees its own; of others only those that the prior is sure of.
    """
    views, *size = prior.distance.shape[1:]
    grid = cameras.resized(*size)
    origins, directions = grid.rays()
    rows, columns = (
        torch.linspace(0, side - 1, min(side, SAMPLES), device=origins.device).round().long()
        for side in size
    )
    points = (origins + prior.distance[..., None] * directions)[0][:, rows][:, :, columns]
    sure = prior.confidence[0][:, rows][:, :, columns].flatten() > SURE
    local = (points.flatten(0, 2) - grid.centers[0, :, None]) @ grid.cam_to_world[0, :, :3, :3]
    place, inside = _places(local, grid)
    there = prior.distance[0].flatten(1).gather(1, place)
    sees = sure & inside & ((local.norm(dim=-1) / there).log().abs() < SAME)
    every = torch.arange(views, device=sees.device)
    sees.unflatten(1, (views, -1))[every, every] = True
    return sees


def _places(
    local: Float[Tensor, "V N 3"], cameras: Cameras
) -> tuple[Int[Tensor, "V N"], Bool[Tensor, "V N"]]:
    """Return the number of the pixel that each point falls on, and whether there is one."""
    depth = local[..., 2]
    pixels = (local @ cameras.intrinsics[0].mT)[..., :2] / depth.clamp_min(1e-9)[..., None]
    size = pixels.new_tensor([cameras.width, cameras.height])
    inside = (depth > 0) & ((pixels >= 0) & (pixels < size)).all(-1)
    column, row = torch.where(inside[..., None], pixels, 0).long().unbind(-1)
    return row * cameras.width + column, inside
