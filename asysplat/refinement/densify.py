"""Where Gaussians are added and dropped: where pixels are wrong, and where they are of no use."""

import torch
import torch.nn.functional as F
from jaxtyping import Float
from torch import Tensor

from asysplat.refinement.start import round_gaussians
from asysplat.rendering import render
from asysplat.scene import Gaussians, Views

LEAST_OPACITY = 0.005  # below it a Gaussian is dropped (Kerbl et al. 2023)
SIZE = 0.5  # standard deviation of a new Gaussian, in pixels
OPACITY = 0.1  # of a new Gaussian
AROUND = 3  # pixels over which an error is averaged: one wrong pixel may be noise


@torch.no_grad()
def gaussians_where_wrong(
    views: Views,
    rendered: Float[Tensor, "V 3 H W"],
    depth: Float[Tensor, "V H W"],
    count: int,
    generator: torch.Generator,
) -> Gaussians:
    """Return Gaussians at pixels of the photographs, drawn as often as they are wrong.

    Each has the pixel's color and lies where the pixel's ray now ends, so that a surface gets the
    detail that the photographs show of it.

    Args:
        views: the photographs, [V].
        rendered: what is rendered of them.
        depth: of the rendering, 0 where nothing is seen.
        count: how many to draw; fewer where fewer pixels are wrong.
        generator: of random numbers.
    """
    error = (views.masked(rendered) - views.images).abs().mean(1)
    error = F.avg_pool2d(error, AROUND, stride=1, padding=AROUND // 2) * (depth > 0)
    if views.masks is not None:
        error = error * views.masks
    count = min(count, int((error > 0).sum()))
    # As torch.multinomial does, which takes no more than 2^24 pixels: the least of exponential
    # times with these rates come first (Efraimidis and Spirakis 2006).
    times = torch.empty(error.shape).exponential_(generator=generator).clamp_min(1e-30)
    chosen = (error / times.to(error)).flatten().topk(count).indices
    cameras = views.cameras
    view = chosen // error[0].numel()
    directions = cameras.pixel_directions().flatten(0, 2)[chosen]
    z = depth.flatten()[chosen]
    pose = cameras.cam_to_world[view]
    means = (pose[:, :3, :3] @ (z[:, None] * directions)[..., None])[..., 0] + pose[:, :3, 3]
    sizes = SIZE * z / cameras.intrinsics[view, 0, 0]
    colors = views.images.movedim(1, -1).flatten(0, 2)[chosen]
    return round_gaussians(means, sizes, torch.full_like(z, OPACITY), colors)


@torch.no_grad()
def look(
    gaussians: Gaussians, views: Views, background: Float[Tensor, "3"]
) -> tuple[Float[Tensor, "V 3 H W"], Float[Tensor, "V H W"]]:
    """Render views one after the other: images, and the depths where half of a ray is hidden."""
    images, depths = [], []
    for view in range(views.num_views):
        out = render(gaussians, views.cameras.select([view]), background, depth="median")
        images.append(out.image)
        depths.append(out.depth)
    return torch.cat(images), torch.cat(depths)
