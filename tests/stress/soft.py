"""Scenes without a discontinuity, for finite differences in every mode."""

from dataclasses import dataclass, field, replace

import torch

from asysplat.rendering import INRIA
from asysplat.scene import Cameras, Gaussians


@dataclass(frozen=True)
class Mode:
    """Args:
    options: of `render`.
    degree: of SH.
    scale: of the Gaussians, beside `make_scene`'s.
    """

    options: dict = field(default_factory=dict)
    degree: int = 1
    scale: float = 5.0


# So wide a dilation that small splats still reach every pixel; half of the opacity is left.
FLOOR = replace(INRIA, eps2d=8.0, compensation_min=0.25)
MODES = {
    "expected": Mode(),
    "accumulated": Mode({"depth": "accumulated"}),
    "median": Mode({"depth": "median"}),
    "antialiased": Mode({"antialiased": True}),
    "antialiased, below the floor": Mode({"antialiased": True, "convention": FLOOR}, scale=0.2),
    "antialiased, above the floor": Mode({"antialiased": True, "convention": FLOOR}),
    "degree 3": Mode(degree=3),
}


def soft_scene(make_scene, mode: Mode, dtype=torch.float64) -> tuple[Gaussians, Cameras]:
    """Wide Gaussians on few pixels: no alpha near a cut-off, no color near 0."""
    gaussians, cameras = make_scene(3, 2, 5, 6, mode.degree)
    gaussians = Gaussians(
        gaussians.means * torch.tensor([0.2, 0.2, 1], dtype=torch.float64),
        gaussians.quats,
        gaussians.scales * mode.scale,
        gaussians.opacities,
        gaussians.sh * 0.3,
    )
    return gaussians.to(dtype), cameras.to(dtype)
