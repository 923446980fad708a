"""Densification by rendering errors: spawn Gaussians at pixels with a large error."""

import torch
import torch.nn.functional as F
from jaxtyping import Float
from torch import Tensor

from asysplat.refinement.isotropic import isotropic_gaussians
from asysplat.scene import Gaussians, Views

MIN_OPACITY = 0.005  # Gaussians below it are pruned (Kerbl et al. 2023)
SPAWN_SIZE = 0.5  # standard deviation of a new Gaussian, in pixels
SPAWN_OPACITY = 0.1
ERROR_WINDOW = 3  # pixels over which errors are averaged, as a single one may be noise


@torch.no_grad()
def spawn_at_errors(
    views: Views,
    rendered: Float[Tensor, "V 3 H W"],
    depth: Float[Tensor, "V H W"],
    count: int,
    generator: torch.Generator,
) -> Gaussians:
    """Sample pixels in proportion to their error, and return a Gaussian at the depth of each.

    Each has the color of its pixel in the input image.

    Args:
        views: input views, [V].
        rendered: their renderings.
        depth: rendered depth, 0 at the background.
        count: number of samples; fewer where fewer pixels have an error.
        generator: of random numbers.
    """
    error = (views.masked(rendered) - views.images).abs().mean(1)
    error = F.avg_pool2d(error, ERROR_WINDOW, stride=1, padding=ERROR_WINDOW // 2) * (depth > 0)
    if views.masks is not None:
        error = error * views.masks
    count = min(count, int((error > 0).sum()))
    # torch.multinomial is limited to 2^24 pixels. The smallest of exponential times with these
    # rates sample the same distribution (Efraimidis and Spirakis 2006).
    times = torch.empty(error.shape).exponential_(generator=generator).clamp_min(1e-30)
    sampled = (error / times.to(error)).flatten().topk(count).indices
    cameras = views.cameras
    view = sampled // error[0].numel()
    directions = cameras.pixel_directions().flatten(0, 2)[sampled]
    z = depth.flatten()[sampled]
    pose = cameras.cam_to_world[view]
    means = (pose[:, :3, :3] @ (z[:, None] * directions)[..., None])[..., 0] + pose[:, :3, 3]
    sizes = SPAWN_SIZE * z / cameras.intrinsics[view, 0, 0]
    colors = views.images.movedim(1, -1).flatten(0, 2)[sampled]
    return isotropic_gaussians(means, sizes, torch.full_like(z, SPAWN_OPACITY), colors)
