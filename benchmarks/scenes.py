"""Procedural scenes to measure renderers on: nothing to download, equal on every machine."""

from collections.abc import Callable
from functools import partial

import torch
from torch import Tensor

from asysplat.scene import Cameras, Gaussians

Sample = Callable[..., Tensor]
Scene = tuple[Gaussians, Cameras]

FOCAL = 0.9  # focal length, in image widths
DISTANCE = 4.0  # typical distance from the camera to the scene; radius of the arc
ARC = 0.5  # angle of the arc, in radians


def random_numbers(seed: int) -> tuple[Sample, Sample]:
    """Return two functions of a shape, which draw uniform and normal numbers in float64."""
    options = {"generator": torch.Generator().manual_seed(seed), "dtype": torch.float64}
    return partial(torch.rand, **options), partial(torch.randn, **options)


def camera_at_origin(focal: float, height: int, width: int) -> Cameras:
    """Return one camera at the world's origin, its focal length in pixels; float32."""
    intrinsics = torch.tensor([[focal, 0, width / 2], [0, focal, height / 2], [0, 0, 1]])
    return Cameras(intrinsics[None], torch.eye(4)[None], height, width)


def random_scene(count: int, height: int, width: int, seed: int = 0) -> Scene:
    """Scatter `count` Gaussians over the image, a margin of 10 % around it, and depths of 2 to 10.

    Positions and depths are uniform, standard deviations log-normal along each axis (median 2
    pixels, sigma 0.6), opacities uniform in 0.05 to 0.95.

    Returns:
        Gaussians [N] of SH degree 0, and one camera; float32.
    """
    uniform, normal = random_numbers(seed)
    depths = 2 + 8 * uniform(count)
    position = 1.2 * uniform(count, 2) - 0.1
    sigma = 2 * (0.6 * normal(count, 3)).exp()
    opacities = 0.05 + 0.9 * uniform(count)
    return _scene(position, depths, sigma, opacities, (height, width), normal)


def pixel_aligned_scene(side: int, height: int, width: int, seed: int = 0) -> Scene:
    """Imitate what networks predict: two jittered grids of side x side Gaussians over the image.

    The Gaussians are in the order of the pixels. Depths are smooth and near 4, standard deviations
    log-normal (median 0.8 width / side pixels, sigma 0.4), opacities sigmoid(2 N(0, 1)).

    Returns:
        Gaussians [2 side^2] of SH degree 0, and one camera; float32.
    """
    uniform, normal = random_numbers(seed)
    count = 2 * side * side
    steps = torch.arange(side, dtype=torch.float64)
    grid = torch.stack(torch.meshgrid(steps, steps, indexing="xy"), -1).flatten(0, 1).repeat(2, 1)
    position = (grid + uniform(count, 2)) / side
    waves = (6 * position[:, 0]).sin() * (5 * position[:, 1]).cos()
    depths = 4 + 0.5 * waves + 0.01 * normal(count)
    sigma = 0.8 * width / side * (0.4 * normal(count, 3)).exp()
    opacities = (2 * normal(count)).sigmoid()
    return _scene(position, depths, sigma, opacities, (height, width), normal)


def place_on_arc(camera: Cameras, views: int) -> Cameras:
    """Copy a camera to `views` poses on an arc of ARC radians, around the point DISTANCE ahead."""
    angles = torch.linspace(-ARC / 2, ARC / 2, views)
    turns = torch.zeros(views, 4, 4)
    turns[:, 0, 0] = turns[:, 2, 2] = angles.cos()
    turns[:, 0, 2], turns[:, 2, 0] = angles.sin(), -angles.sin()
    turns[:, 1, 1] = turns[:, 3, 3] = 1
    turns[:, 2, 3] = DISTANCE
    turns[:, :3, 3] -= DISTANCE * turns[:, :3, 2]
    intrinsics = camera.intrinsics.expand(views, 3, 3)
    return Cameras(intrinsics, camera.cam_to_world @ turns, camera.height, camera.width)


def _scene(
    position: Tensor,
    depths: Tensor,
    sigma: Tensor,
    opacities: Tensor,
    size: tuple[int, int],
    normal: Sample,
) -> Scene:
    """Make a camera, and Gaussians that project to given positions.

    Args:
        position: positions in the image, as fractions of its width and height.
        depths: depth of each Gaussian.
        sigma: standard deviations in pixels.
        size: height and width of the image.
        normal: source of the orientations and colors.
    """
    height, width = size
    focal = FOCAL * width
    offsets = position * torch.tensor([width, height]) - torch.tensor([width / 2, height / 2])
    gaussians = Gaussians(
        means=torch.cat((offsets / focal * depths[:, None], depths[:, None]), -1),
        quats=normal(len(depths), 4),
        scales=sigma * depths[:, None] / focal,
        opacities=opacities,
        sh=normal(len(depths), 1, 3),
    )
    return gaussians.to(torch.float32), camera_at_origin(focal, height, width)


def _scene_on_an_arc(views: int) -> Scene:
    gaussians, camera = pixel_aligned_scene(256, 256, 256)
    return gaussians, place_on_arc(camera, views)


SCENES = {
    "A": partial(random_scene, 50_000, 256, 256),
    "B": partial(random_scene, 50_000, 540, 960),
    "C": partial(pixel_aligned_scene, 256, 256, 256),
    "524k": partial(pixel_aligned_scene, 512, 256, 256),
    "4M": partial(pixel_aligned_scene, 1414, 540, 960),
    "131kx16": partial(_scene_on_an_arc, 16),
}
SMALLER = {  # scenes on which errors are measured instead: float64 takes too long on the large ones
    "4M": partial(pixel_aligned_scene, 354, 135, 240),
    "131kx16": partial(_scene_on_an_arc, 2),
}
