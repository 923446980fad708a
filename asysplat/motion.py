"""Gaussians, moved from one coordinate frame to another."""

from dataclasses import replace

import torch
from jaxtyping import Float
from scipy.spatial.transform import Rotation
from torch import Tensor

from asysplat.rendering.reference.math import sh_basis
from asysplat.scene import Gaussians


def transform(gaussians: Gaussians, motion: Float[Tensor, "4 4"]) -> Gaussians:
    """Apply a rigid motion to Gaussians: cameras moved alike render the same images.

    Computed in float64; the fields keep their types.

    Args:
        motion: from the Gaussians' frame to the new one.
    """
    motion = motion.to(gaussians.means.device, torch.float64)
    rotation, translation = motion[:3, :3], motion[:3, 3]
    means = gaussians.means.double() @ rotation.mT + translation
    turn = torch.tensor(Rotation.from_matrix(rotation.cpu().numpy()).as_quat(scalar_first=True))
    quats = _quaternion_product(turn.to(motion), gaussians.quats.double())
    matrix = sh_rotation(rotation, gaussians.sh.shape[-2])
    return replace(
        gaussians,
        means=means.to(gaussians.means),
        quats=quats.to(gaussians.quats),
        sh=(matrix @ gaussians.sh.double()).to(gaussians.sh),
    )


def sh_rotation(rotation: Float[Tensor, "3 3"], count: int) -> Float[Tensor, "{count} {count}"]:
    """Return the matrix that rotates SH coefficients.

    The color that `count` (1, 4, 9 or 16) coefficients give along d is the one that the rotated
    coefficients give along R d. A rotated SH function is a sum of SH functions of its degree, so
    its values in enough directions determine the matrix exactly.
    """
    directions = _around_the_sphere(2 * count).to(rotation)
    before = sh_basis(directions @ rotation, count)  # along R^-1 d
    return torch.linalg.pinv(sh_basis(directions, count)) @ before


def _around_the_sphere(count: int) -> Float[Tensor, "{count} 3"]:
    """Spread directions nearly evenly, on a Fibonacci spiral."""
    index = torch.arange(count, dtype=torch.float64) + 0.5
    z = 1 - 2 * index / count
    angle = index * torch.pi * (1 + 5**0.5)
    radius = (1 - z * z).sqrt()
    return torch.stack((radius * angle.cos(), radius * angle.sin(), z), -1)


def _quaternion_product(
    first: Float[Tensor, "4"], second: Float[Tensor, "*batch 4"]
) -> Float[Tensor, "*batch 4"]:
    """Multiply quaternions wxyz: the rotation by `second`, then by `first`."""
    w, x, y, z = first.tolist()
    rows = [[w, -x, -y, -z], [x, w, -z, y], [y, z, w, -x], [z, -y, x, w]]
    return second @ second.new_tensor(rows).mT
