"""Scenes whose splats end where a tile begins, to within the precision of float32."""

import math

import torch

from asysplat.rendering import INRIA
from asysplat.rendering.cpu.splat import TILE
from asysplat.rendering.formulas import EXPONENT_MARGIN, PIXEL_MARGIN
from asysplat.rendering.interface import RenderSettings
from asysplat.rendering.reference.project import project_footprints
from asysplat.scene import Cameras, Gaussians
from benchmarks.scenes import random_scene

BAND = 2e-5  # pixels


def tangent_scene(
    count: int, height: int, width: int, seed: int = 0, tile: int = TILE
) -> tuple[Gaussians, Cameras]:
    """Make Gaussians [N] of sigma 1 to 10 pixels, whose boxes touch tile edges, and one camera.

    A quarter of the boxes each end at a tile's right, left, bottom or top edge, give or take BAND,
    one in eight of them in both directions; so far away that moving them changes no shape.
    """
    generator = torch.Generator().manual_seed(seed)

    def uniform(*shape: int) -> torch.Tensor:
        return torch.rand(*shape, generator=generator, dtype=torch.float64)

    gaussians, cameras = random_scene(count, height, width, seed)
    gaussians, cameras = gaussians.to(torch.float64), cameras.to(torch.float64)
    away = 1000.0  # times as far and as large on the image
    gaussians.means[:, 2] *= away
    cameras.intrinsics[:, :2, :2] *= away
    pixel = gaussians.means[:, 2:] / cameras.intrinsics[0, 0, 0]
    gaussians.scales[:] = 10 ** uniform(count, 1) * (0.3 + 0.7 * uniform(count, 3)) * pixel

    pose, pinhole = cameras.cam_to_world[0], cameras.intrinsics[0]
    side = torch.arange(count) % 4
    both = torch.arange(count) // 4 % 8 == 0
    for _ in range(2):
        footprint = project_footprints(
            gaussians.means, gaussians.quats, gaussians.scales, pose, pinhole, (width, height),
            RenderSettings(),
        )  # fmt: skip
        room = (gaussians.opacities / INRIA.alpha_min).log2() + EXPONENT_MARGIN
        extent = (2 * math.log(2) * room).sqrt()[:, None] * footprint.deviations
        # First and last pixel center of its extent: where one is whole, its tile may change.
        last = footprint.xy + extent - 0.5 + PIXEL_MARGIN
        first = footprint.xy - extent - 0.5 - PIXEL_MARGIN
        to_last = (last / tile).round() * tile - last
        to_first = ((first + 1) / tile).round() * tile - 1 - first
        shift = torch.where((side % 2 == 0)[:, None], to_last, to_first)
        shift += BAND * (2 * uniform(count, 2) - 1)
        chosen = torch.stack((side < 2, side >= 2), -1) | both[:, None]
        gaussians.means[:, :2] += shift * chosen * pixel
    return gaussians.to(torch.float32), cameras.to(torch.float32)
