"""Rotations and rigid motions."""

from dataclasses import replace

import torch
from jaxtyping import Float
from scipy.spatial.transform import Rotation
from torch import Tensor

from asysplat.geometry.spherical_harmonics import sh_rotation
from asysplat.kernels.dispatch import to_float64
from asysplat.scene import Gaussians


def rotations(quats: Tensor) -> Tensor:
    """Convert quaternions [..., 4] wxyz of any length to rotations [..., 3, 3]."""
    # Squares of a tiny or huge quaternion would leave float32's range.
    quats = quats / quats.detach().abs().amax(-1, keepdim=True)
    w, x, y, z = (quats / quats.norm(dim=-1, keepdim=True)).unbind(-1)
    rows = (
        *(1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)),
        *(2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)),
        *(2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)),
    )
    return torch.stack(rows, -1).unflatten(-1, (3, 3))


def transform(gaussians: Gaussians, motion: Float[Tensor, "4 4"]) -> Gaussians:
    """Apply a rigid motion to Gaussians; cameras that move along render the same images.

    Computed in float64; the fields keep their types.

    Args:
        motion: from the Gaussians' frame to the new one.
    """
    means = to_float64(gaussians.means)
    motion = motion.to(means)
    rotation, translation = motion[:3, :3], motion[:3, 3]
    means = means @ rotation.mT + translation
    w, x, y, z = Rotation.from_matrix(rotation.cpu().numpy()).as_quat(scalar_first=True)
    product = [[w, -x, -y, -z], [x, w, -z, y], [y, z, w, -x], [z, -y, x, w]]
    quats = gaussians.quats.double() @ motion.new_tensor(product).mT
    matrix = sh_rotation(rotation, gaussians.sh.shape[-2])
    return replace(
        gaussians,
        means=means.to(gaussians.means),
        quats=quats.to(gaussians.quats),
        sh=(matrix @ gaussians.sh.double()).to(gaussians.sh),
    )


def fit_similarity(
    source: Float[Tensor, "P 3"], target: Float[Tensor, "P 3"]
) -> tuple[Float[Tensor, "4 4"], float]:
    """Fit the rigid motion, and the scale applied after it, that take points to their targets.

    Least squares in float64 (Umeyama 1991, Eq. 40 to 43); points on a line leave the rotation open.
    """
    source, target = source.double(), target.double()
    centered, centered_target = source - source.mean(0), target - target.mean(0)
    left, values, right = torch.linalg.svd(centered_target.mT @ centered)
    signs = torch.tensor([1.0, 1.0, 1.0]).to(source)
    signs[2] = torch.linalg.det(left @ right).sign()  # no mirroring
    scale = (values * signs).sum() / centered.square().sum()
    motion = torch.eye(4).to(source)
    motion[:3, :3] = left * signs @ right
    motion[:3, 3] = target.mean(0) / scale - motion[:3, :3] @ source.mean(0)
    return motion, scale.item()
