"""Rotation matrices of quaternions."""

import torch
from torch import Tensor


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
