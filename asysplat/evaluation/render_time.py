"""How long the renderer takes of a training step."""

import statistics
import time

import torch
from torch import Tensor

from asysplat.rendering import render
from asysplat.scene import Cameras, Gaussians

REPEATS = 5


def wait_for(device: torch.device) -> None:
    """A GPU works on after the call returns; a time is taken when it has finished."""
    if device.type == "cuda":
        torch.cuda.synchronize(device)


def render_seconds(
    gaussians: Gaussians, cameras: Cameras, background: Tensor, depth: bool
) -> float:
    """Median seconds of one rendering and of the gradients of all Gaussian fields.

    Args:
        gaussians, cameras, background, depth: as for `render`.
    """
    leaves = gaussians.map(lambda tensor: tensor.detach().requires_grad_())
    device = gaussians.means.device
    seconds = []
    for _ in range(REPEATS + 1):
        wait_for(device)
        started = time.perf_counter()
        with torch.enable_grad():
            out = render(leaves, cameras, background, depth=depth)
            total = out.image.sum() if out.depth is None else out.image.sum() + out.depth.sum()
        total.backward()
        wait_for(device)
        seconds.append(time.perf_counter() - started)
    return statistics.median(seconds[1:])  # the first may compile
