"""Place a Gaussian at every pixel of three images and render views between them.

python examples/render_scene.py [figure.png]
"""

import sys
from pathlib import Path

import torch

from asysplat import Gaussians, Views, render
from asysplat.data import ProceduralScene
from asysplat.evaluation.figures import comparison_figure
from asysplat.geometry.spherical_harmonics import SH_C0
from asysplat.interrupts import handle_signals


def gaussians_from_depths(views: Views) -> Gaussians:
    """Build isotropic Gaussians of a pixel's size at the depth of each pixel."""
    cameras = views.cameras
    rotations = cameras.cam_to_world[:, None, None, :3, :3]
    directions = (rotations @ cameras.pixel_directions()[..., None]).squeeze(-1)
    means = cameras.centers[:, None, None] + views.depths[..., None] * directions
    pixel = views.depths / cameras.intrinsics[:, 0, 0, None, None]
    colors = views.images.movedim(1, -1)
    num = pixel.numel()
    return Gaussians(
        means=means.reshape(num, 3),
        quats=torch.tensor([1.0, 0.0, 0.0, 0.0]).repeat(num, 1),
        scales=0.6 * pixel.reshape(num, 1).repeat(1, 3),
        opacities=torch.full((num,), 0.95),
        sh=((colors - 0.5) / SH_C0).reshape(num, 1, 3),
    )


def main(figure: Path) -> None:
    scene = ProceduralScene(seed=5, height=128, width=128)
    inputs, targets = scene.views([0, 12, 24]), scene.views([6, 18])
    rendering = render(gaussians_from_depths(inputs), targets.cameras)
    comparison_figure(inputs, targets, rendering).savefig(figure, dpi=120)
    print(f"{rendering.stats['visible']:,} visible Gaussians; figure: {figure}")


if __name__ == "__main__":
    handle_signals()
    main(Path(sys.argv[1] if len(sys.argv) > 1 else "render_scene.png"))
