"""Which pixels of a view show what some input photograph shows, too."""

from collections.abc import Iterable

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from asysplat.scene import Cameras

SAME_DEPTH = 0.05  # relative difference of two depths of one surface


def seen_by_inputs(
    depth: Float[Tensor, "T H W"],
    cameras: Cameras,
    input_depths: Iterable[Float[Tensor, "h w"]],
    inputs: Cameras,
) -> Bool[Tensor, "T H W"]:
    """Compute whether the surface at each pixel is what some input sees there.

    Args:
        depth: depths of T views, as `render` returns them; where they are 0, nothing is seen.
        input_depths: those of the inputs, one by one: they are taken once, and not kept.
    """
    pose, local = cameras.cam_to_world[:, None, None], cameras.pixel_directions() * depth[..., None]
    points = ((pose[..., :3, :3] @ local[..., None])[..., 0] + pose[..., :3, 3]).flatten(0, 2)
    seen = torch.zeros_like(depth, dtype=torch.bool).flatten()
    for view, input_depth in enumerate(input_depths):
        pixels, apart, inside = (part[0] for part in inputs.select([view]).project(points))
        column, row = pixels[inside].long().unbind(-1)
        found = input_depth[row, column]
        seen[inside] |= (apart[inside] - found).abs() < SAME_DEPTH * found
    return seen.view(depth.shape) & (depth > 0)
