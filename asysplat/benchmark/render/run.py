"""The renderers that can run on this machine: one forward and one backward pass of each."""

import importlib.util
import math
from dataclasses import fields
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from asysplat.benchmark.scenes import Scene
from asysplat.benchmark.timing import now, relative_l2
from asysplat.ops.simd.threads import time_kernels
from asysplat.rendering import GSPLAT_1_5, INRIA, Convention, Culling, render
from asysplat.scene import Cameras, Gaussians

CULLING = tuple(field.name for field in fields(Culling))
SKIPS_OF_CUDA = tuple(name for name in CULLING if name != "rows")
FIELDS = tuple(field.name for field in fields(Gaussians))
FLIP = 1e-4  # a difference that rounding alone does not make; a flip makes up to 1/255


class Backend(NamedTuple):
    """A renderer."""

    name: str  # as the tables have it
    device: str  # where its tensors are
    culling: tuple[str, ...] = ()  # names of those that it can switch off
    convention: Convention = INRIA  # its cut-offs


class Inputs(NamedTuple):
    """A scene on the device of a backend."""

    gaussians: Gaussians  # whose gradients are asked for
    cameras: Cameras
    weights: Tensor  # [V, 3, H, W] the gradient of the image, from a normal distribution


class Outputs(NamedTuple):
    """The results of both passes."""

    image: Tensor  # [V, 3, H, W]
    gradients: tuple[Tensor, ...]  # of each of FIELDS
    seconds: dict[str, float]  # of "forward" and "backward"
    kernels: dict[str, float]  # seconds of each kernel, of the cpu backend
    stats: dict[str, int]


def find_backends() -> list[Backend]:
    """List the reference, which every table has, then the fast ones that can run here."""
    found = [Backend("reference", "cpu"), Backend("cpu", "cpu", CULLING)]
    if torch.cuda.is_available():
        found.append(Backend("cuda", "cuda", SKIPS_OF_CUDA))
        if importlib.util.find_spec("gsplat"):
            found.append(Backend("gsplat", "cuda", convention=GSPLAT_1_5))
    return found


def _draw(backend: Backend, culling: Culling, inputs: Inputs) -> tuple[Tensor, dict[str, int]]:
    """Draw the image [V, 3, H, W] without background; return also counts."""
    gaussians, cameras, _ = inputs
    if backend.name == "gsplat":
        return _draw_by_gsplat(gaussians, cameras)
    choices = {"backend": backend.name, "culling": culling, "convention": backend.convention}
    out = render(gaussians, cameras, depth=False, **choices)
    return out.image, out.stats


def _draw_by_gsplat(gaussians: Gaussians, cameras: Cameras) -> tuple[Tensor, dict[str, int]]:
    """Draw with gsplat 1.5 in its faster form, not the packed one; it has no skips to switch."""
    from gsplat import rasterization

    images, _, meta = rasterization(
        means=gaussians.means,
        quats=gaussians.quats,
        scales=gaussians.scales,
        opacities=gaussians.opacities,
        colors=gaussians.sh,
        viewmats=torch.linalg.inv(cameras.cam_to_world),
        Ks=cameras.intrinsics,
        width=cameras.width,
        height=cameras.height,
        sh_degree=math.isqrt(gaussians.sh.shape[-2]) - 1,
        packed=False,
    )
    stats = {"pairs": len(meta["flatten_ids"]), "tile_size": meta["tile_size"]}
    return images.movedim(-1, -3), stats


def prepare(scene: Scene, device: str, ignored: Tensor | None = None) -> Inputs:
    """Move a scene to a device.

    The weights are the same at every call, but for 0 at the pixels `ignored`, [V, H, W].
    """
    gaussians, cameras = (part.to(device) for part in scene)
    size = (cameras.num_views, 3, cameras.height, cameras.width)
    weights = torch.randn(size, generator=torch.Generator().manual_seed(1))
    if ignored is not None:
        weights = weights * ~ignored[:, None]
    leaves = gaussians.map(lambda tensor: tensor.detach().requires_grad_())
    return Inputs(leaves, cameras, weights.to(gaussians.means))


def run(backend: Backend, culling: Culling, inputs: Inputs) -> Outputs:
    """Draw, and take the gradients."""
    leaves = [getattr(inputs.gaussians, name) for name in FIELDS]
    device = torch.device(backend.device)
    with time_kernels() as kernels:
        start = now(device)
        image, stats = _draw(backend, culling, inputs)
        middle = now(device)
        gradients = torch.autograd.grad(image, leaves, inputs.weights)
        seconds = {"forward": middle - start, "backward": now(device) - middle}
    return Outputs(image.detach(), gradients, seconds, kernels, stats)


def truth(scene: Scene, convention: Convention, ignored: Tensor | None = None) -> Outputs:
    """Draw the scene in float64."""
    exact = tuple(part.to(torch.float64) for part in scene)
    reference = Backend("reference", "cpu", convention=convention)
    return run(reference, Culling(), prepare(exact, "cpu", ignored))


def flips(found: Outputs, exact: Outputs) -> Tensor:
    """Find the pixels [V, H, W] at which rounding decided otherwise at a cut-off."""
    return ((found.image.cpu().double() - exact.image).abs() > FLIP).any(1)


def errors(found: Outputs, exact: Outputs, ignored: Tensor) -> dict[str, float | dict[str, float]]:
    """Compare images and gradients outside the pixels `ignored`, whose share is given.

    Of the image, the largest difference and the 99th percentile; of each gradient, the relative L2.
    """
    wrong = (found.image.cpu().double() - exact.image).abs() * ~ignored[:, None]
    gradients = map(relative_l2, found.gradients, exact.gradients)
    return {
        "flipped": ignored.double().mean().item(),
        "image_max": wrong.max().item(),
        "image_p99": float(np.percentile(wrong.numpy(), 99)),
        "gradients": dict(zip(FIELDS, gradients, strict=True)),
    }
