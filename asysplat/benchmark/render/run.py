"""One forward and one backward pass: how long, how much memory, how wrong."""

import time
from dataclasses import dataclass, fields

import numpy as np
import torch
from torch import Tensor

from asysplat.benchmark.render.backends import Backend
from asysplat.benchmark.render.cases import Scene
from asysplat.benchmark.timing import rise_gb
from asysplat.evaluation.measured_cost import wait_for
from asysplat.rendering import Convention, Skips, render
from asysplat.scene import Cameras, Gaussians

FLIP = 1e-4  # a difference that rounding alone does not make; a flip makes up to 1/255
FIELDS = tuple(field.name for field in fields(Gaussians))


@dataclass(frozen=True)
class Inputs:
    """
    Args:
        gaussians: whose gradients are asked for.
        cameras: on the same device.
        weights: [V, 3, H, W] the gradient of the image, from a normal distribution.
    """

    gaussians: Gaussians
    cameras: Cameras
    weights: Tensor


@dataclass(frozen=True)
class Pass:
    """
    Args:
        image: [V, 3, H, W].
        gradients: of each of FIELDS.
        forward, backward: seconds.
        stats: counts of what was done.
    """

    image: Tensor
    gradients: tuple[Tensor, ...]
    forward: float
    backward: float
    stats: dict[str, int]


def prepare(scene: Scene, device: str, ignored: Tensor | None = None) -> Inputs:
    """The same weights at every call, but for 0 at the pixels `ignored`, [V, H, W]."""
    gaussians, cameras = (part.to(device) for part in scene)
    size = (cameras.num_views, 3, cameras.height, cameras.width)
    weights = torch.randn(size, generator=torch.Generator().manual_seed(1))
    if ignored is not None:
        weights = weights * ~ignored[:, None]
    leaves = gaussians.map(lambda tensor: tensor.detach().requires_grad_())
    return Inputs(leaves, cameras, weights.to(gaussians.means))


def run(backend: Backend, skips: Skips, inputs: Inputs) -> Pass:
    """Draw, and take the gradients."""
    fields = [getattr(inputs.gaussians, name) for name in FIELDS]
    device = torch.device(backend.device)
    start = _now(device)
    image, stats = backend.draw(inputs.gaussians, inputs.cameras, skips)
    middle = _now(device)
    gradients = torch.autograd.grad(image, fields, inputs.weights)
    end = _now(device)
    return Pass(image.detach(), gradients, middle - start, end - middle, stats)


def peak_gb(backend: Backend, skips: Skips, inputs: Inputs) -> float:
    """What a pass takes beyond what there was before it, in 1e9 bytes; see `rise_gb`."""
    return rise_gb(lambda: run(backend, skips, inputs), torch.device(backend.device))


def truth(scene: Scene, convention: Convention, ignored: Tensor | None = None) -> Pass:
    """The scene in float64."""

    def draw(gaussians, cameras, skips):
        out = render(gaussians, cameras, backend="reference", depth=False, convention=convention)
        return out.image, out.stats

    exact = tuple(part.to(torch.float64) for part in scene)
    return run(Backend("truth", "cpu", draw), Skips(), prepare(exact, "cpu", ignored))


def flips(found: Pass, exact: Pass) -> Tensor:
    """[V, H, W] pixels at which rounding decided otherwise at a cut-off."""
    return ((found.image.cpu().double() - exact.image).abs() > FLIP).any(1)


def errors(found: Pass, exact: Pass, ignored: Tensor) -> dict[str, float | dict[str, float]]:
    """Of the image, the largest and the 99th percentile; of each gradient, relative in L2; outside
    the pixels `ignored`, whose share is given."""
    wrong = (found.image.cpu().double() - exact.image).abs() * ~ignored[:, None]
    pairs = zip(FIELDS, found.gradients, exact.gradients, strict=True)
    return {
        "flipped": ignored.double().mean().item(),
        "image_max": wrong.max().item(),
        "image_p99": float(np.percentile(wrong.numpy(), 99)),
        "gradients": {
            name: ((grad.cpu().double() - true).norm() / true.norm()).item()
            for name, grad, true in pairs
        },
    }


def _now(device: torch.device) -> float:
    wait_for(device)
    return time.perf_counter()
