"""Gaussians of one size in all directions and one color."""

import torch
from jaxtyping import Float
from torch import Tensor

from asysplat.geometry.spherical_harmonics import SH_C0
from asysplat.scene import Gaussians


def isotropic_gaussians(
    means: Float[Tensor, "N 3"],
    scales: Float[Tensor, "N"],
    opacities: Float[Tensor, "N"],
    colors: Float[Tensor, "N 3"],
) -> Gaussians:
    """Build Gaussians with one scale for all axes and SH of degree 0."""
    quats = torch.zeros(len(means), 4).to(means)
    quats[:, 0] = 1
    return Gaussians(
        means=means,
        quats=quats,
        scales=scales[:, None].repeat(1, 3),
        opacities=opacities,
        sh=((colors - 0.5) / SH_C0)[:, None],
    )
