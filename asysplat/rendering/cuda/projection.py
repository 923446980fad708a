"""Gaussians to the splats that the kernels read.

A first version: the formulas and the gradient are those of the reference, in torch operations.
"""

import math

import torch
from jaxtyping import Float, Int
from torch import Tensor

from asysplat.rendering.cuda.sums import Gather
from asysplat.rendering.reference.projection import find_footprint, find_visible
from asysplat.rendering.reference.sh import sh_colors
from asysplat.rendering.settings import Settings
from asysplat.scene import Cameras, Gaussians

WHITEN_TO_LOG2 = math.sqrt(0.5 / math.log(2))  # exp(-x^2 / 2) = 2^-(WHITEN_TO_LOG2 x)^2


def project(
    gaussians: Gaussians, cameras: Cameras, settings: Settings
) -> tuple[Int[Tensor, "M"], Float[Tensor, "M C"]]:
    """The image and the splat of every visible pair, sorted by image, then by depth.

    A splat is x, y, a, b, c, opacity, red, green, blue, and the depth where one is asked for,
    float32: at (dx, dy) pixels from (x, y) it has alpha = opacity 2^-((a dx + b dy)^2 + (c dy)^2).
    """
    images, indices = find_visible(gaussians, cameras, settings)
    take = Gather(indices, gaussians.opacities.numel())
    per_image = torch.bincount(
        images, minlength=cameras.intrinsics.shape[0] * cameras.num_views
    ).tolist()

    def of_image(matrices: Tensor) -> Tensor:
        """[B, V, ...] to [M, ...]; its gradient is one sum an image."""
        rows = zip(matrices.flatten(0, 1), per_image, strict=True)
        return torch.cat([matrix.expand(count, -1, -1) for matrix, count in rows])

    footprint = find_footprint(
        take(gaussians.means.flatten(0, 1)),
        take(gaussians.quats.flatten(0, 1)),
        take(gaussians.scales.flatten(0, 1)),
        of_image(cameras.cam_to_world),
        of_image(cameras.intrinsics),
        (cameras.width, cameras.height),
        settings,
    )
    columns = [
        footprint.xy,
        footprint.whitening * WHITEN_TO_LOG2,
        (take(gaussians.opacities.flatten()) * footprint.compensation)[:, None],
        sh_colors(take(gaussians.sh.flatten(0, 1)), footprint.offsets),
    ]
    if settings.depth is not None:
        columns.append(footprint.depths[:, None])
    return images, torch.cat(columns, -1).float()
