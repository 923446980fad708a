"""Synthetic scenes to measure renderers on: nothing to download, the same on every machine."""

import torch
from torch import Tensor

from asysplat.scene import Cameras, Gaussians

FOCAL = 0.9  # of the image's width
DISTANCE = 4.0  # from the camera to what networks predict
ARC = 0.5  # radians


def random_scene(count: int, height: int, width: int, seed: int = 0) -> tuple[Gaussians, Cameras]:
    """Scatter `count` Gaussians over the image and 10 % beyond it, and over depths.

    Positions are uniform, depths uniform in 2 to 10, deviations log-normal (median 2 pixels, 0.6)
    per axis, opacities uniform in .05 to .95.

    Returns:
        Gaussians [N] of SH degree 0, and one camera; float32.
    """
    generator = torch.Generator().manual_seed(seed)
    depths = 2 + 8 * torch.rand(count, generator=generator, dtype=torch.float64)
    place = 1.2 * torch.rand(count, 2, generator=generator, dtype=torch.float64) - 0.1
    pixels = place * torch.tensor([width, height])
    sigma = 2 * (0.6 * _normal(count, 3, generator=generator)).exp()
    opacities = 0.05 + 0.9 * torch.rand(count, generator=generator, dtype=torch.float64)
    return _scene(pixels, depths, sigma, opacities, height, width, generator)


def pixel_aligned_scene(
    side: int, height: int, width: int, seed: int = 0
) -> tuple[Gaussians, Cameras]:
    """Imitate what networks predict: two jittered grids of side x side Gaussians over the image.

    Depths are smooth and near 4, deviations log-normal (median 0.8 width / side pixels, 0.4),
    opacities sigmoid(2 N(0, 1)); in the order of the pixels.

    Returns:
        Gaussians [2 side^2] of SH degree 0, and one camera; float32.
    """
    generator = torch.Generator().manual_seed(seed)
    count = 2 * side * side
    steps = torch.arange(side, dtype=torch.float64)
    grid = torch.stack(torch.meshgrid(steps, steps, indexing="xy"), -1).flatten(0, 1).repeat(2, 1)
    place = (grid + torch.rand(count, 2, generator=generator, dtype=torch.float64)) / side
    pixels = place * torch.tensor([width, height])
    waves = (6 * place[:, 0]).sin() * (5 * place[:, 1]).cos()
    depths = 4 + 0.5 * waves + 0.01 * _normal(count, generator=generator)
    sigma = 0.8 * width / side * (0.4 * _normal(count, 3, generator=generator)).exp()
    opacities = (2 * _normal(count, generator=generator)).sigmoid()
    return _scene(pixels, depths, sigma, opacities, height, width, generator)


def on_an_arc(camera: Cameras, views: int) -> Cameras:
    """Copy a camera to `views` places on an arc of ARC radians about what is DISTANCE before it."""
    angles = torch.linspace(-ARC / 2, ARC / 2, views)
    turns = torch.zeros(views, 4, 4)
    turns[:, 0, 0] = turns[:, 2, 2] = angles.cos()
    turns[:, 0, 2], turns[:, 2, 0] = angles.sin(), -angles.sin()
    turns[:, 1, 1] = turns[:, 3, 3] = 1
    turns[:, 2, 3] = DISTANCE
    turns[:, :3, 3] -= DISTANCE * turns[:, :3, 2]
    return Cameras(
        camera.intrinsics.expand(views, 3, 3),
        camera.cam_to_world @ turns,
        camera.height,
        camera.width,
    )


def _normal(*shape: int, generator: torch.Generator) -> Tensor:
    return torch.randn(*shape, generator=generator, dtype=torch.float64)


def _scene(
    pixels: Tensor,
    depths: Tensor,
    sigma: Tensor,
    opacities: Tensor,
    height: int,
    width: int,
    generator: torch.Generator,
) -> tuple[Gaussians, Cameras]:
    """Make Gaussians that project to `pixels` with `sigma` pixels, and the camera they do so in."""
    count = len(depths)
    focal = FOCAL * width
    center = torch.tensor([width / 2, height / 2])
    means = torch.cat(((pixels - center) / focal * depths[:, None], depths[:, None]), -1)
    gaussians = Gaussians(
        means=means,
        quats=_normal(count, 4, generator=generator),
        scales=sigma * depths[:, None] / focal,
        opacities=opacities,
        sh=_normal(count, 1, 3, generator=generator),
    )
    intrinsics = torch.tensor([[focal, 0, width / 2], [0, focal, height / 2], [0, 0, 1]])
    cameras = Cameras(intrinsics[None], torch.eye(4)[None], height, width)
    return gaussians.to(torch.float32), cameras.to(torch.float32)
