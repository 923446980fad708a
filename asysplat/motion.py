"""Rigid motions of Gaussians."""

from dataclasses import replace

import torch
from jaxtyping import Float
from scipy.spatial.transform import Rotation
from torch import Tensor

from asysplat.rendering.sh import sh_rotation
from asysplat.scene import Gaussians


def transform(gaussians: Gaussians, motion: Float[Tensor, "4 4"]) -> Gaussians:
    """Apply a rigid motion to Gaussians; cameras that move along render the same images.

    Computed in float64; the fields keep their types.

    Args:
        motion: from the Gaussians' frame to the new one.
    """
    motion = motion.to(gaussians.means.device, torch.float64)
    rotation, translation = motion[:3, :3], motion[:3, 3]
    means = gaussians.means.double() @ rotation.mT + translation
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
