"""How long the renderer takes of a training step."""

import torch
from torch import Tensor

from asysplat.evaluation.measured import Measured, mean_but_longest
from asysplat.rendering import render
from asysplat.scene import Cameras, Gaussians

REPEATS = 6  # the longest, which may have compiled, does not count


def render_seconds(
    gaussians: Gaussians, cameras: Cameras, background: Tensor, depth: bool
) -> float:
    """Seconds of one rendering and of the gradients of all Gaussian fields (`mean_but_longest`).

    Args:
        gaussians, cameras, background, depth: as for `render`.
    """
    leaves = gaussians.map(lambda tensor: tensor.detach().requires_grad_())
    work = Measured(gaussians.means.device)
    for _ in range(REPEATS):
        work.start()
        with torch.enable_grad():
            out = render(leaves, cameras, background, depth=depth)
            total = out.image.sum() if out.depth is None else out.image.sum() + out.depth.sum()
        total.backward()
        work.stop()
    return mean_but_longest(work.seconds)
