"""Arithmetic of the reference: rotations and ellipses."""

import torch
from torch import Tensor

from asysplat.rendering.interface import RenderSettings


def whiten(row_x: Tensor, row_y: Tensor, settings: RenderSettings) -> tuple[Tensor, Tensor, Tensor]:
    """Factorize the covariance M M^T + eps I, M = (row_x; row_y).

    Return the whitening (a, b, c), which is the Cholesky factor of the inverse; the standard
    deviations along x and y; the factor of the opacity for antialiasing. The determinant is a sum
    of squares (Cauchy-Binet), which cancels to zero for no needle; it is divided by Syy early, so
    that no large scale overflows.
    """
    eps = settings.convention.eps2d
    xx, xy, yy = ((p * q).sum(-1) for p, q in ((row_x, row_x), (row_x, row_y), (row_y, row_y)))
    var_y = yy + eps
    deviation_y = var_y.sqrt()
    minors = torch.linalg.cross(row_x, row_y / deviation_y[..., None]).square().sum(-1)
    det = minors + eps * (1 + xx / var_y)  # over Syy
    a = det.rsqrt()
    whitening = torch.stack((a, -a * xy / var_y, 1 / deviation_y), -1)
    deviations = torch.stack(((xx + eps).sqrt(), deviation_y), -1)
    if not settings.antialiased:
        return whitening, deviations, torch.ones_like(a)
    # sqrt(det(M M^T) / det(M M^T + eps I)), Yu et al. 2024, Eq. 10.
    share = (minors / det).clamp_min(settings.convention.compensation_min)
    return whitening, deviations, share.sqrt()


def rotations(quats: Tensor) -> Tensor:
    """Convert quaternions [..., 4] wxyz of any length to rotations [..., 3, 3]."""
    w, x, y, z = (quats / quats.norm(dim=-1, keepdim=True)).unbind(-1)
    rows = (
        *(1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)),
        *(2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)),
        *(2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)),
    )
    return torch.stack(rows, -1).unflatten(-1, (3, 3))
