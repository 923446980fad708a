"""Arithmetic of the reference: rotations, ellipses, and colors from spherical harmonics (SH)."""

import math

import torch
from jaxtyping import Float
from torch import Tensor

from asysplat.rendering.interface import TINY, RenderSettings


def whiten(row_x: Tensor, row_y: Tensor, settings: RenderSettings) -> tuple[Tensor, Tensor, Tensor]:
    """Factorize the covariance M M^T + eps I, M = (row_x; row_y).

    Return the whitening (a, b, c), which is the Cholesky factor of the inverse; the standard
    deviations along x and y; the factor that antialiasing lowers the opacity by. The determinant is
    a sum of squares (Cauchy-Binet), so no needle makes it cancel to zero, and it is divided by Syy
    early, so no large scale overflows.
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
    """Turn quaternions [..., 4] wxyz of any length into rotations [..., 3, 3]."""
    w, x, y, z = (quats / quats.norm(dim=-1, keepdim=True)).unbind(-1)
    rows = (
        *(1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)),
        *(2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)),
        *(2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)),
    )
    return torch.stack(rows, -1).unflatten(-1, (3, 3))


def sh_basis(
    directions: Float[Tensor, "*points 3"], count: int
) -> Float[Tensor, "*points {count}"]:
    """Evaluate the first `count` (1, 4, 9 or 16) orthonormal SH functions at unit directions.

    Order: degree l up to 3, then m from -l to l. Odd m have the Condon-Shortley sign, as in
    Kerbl et al. 2023 and INRIA's code.
    """
    x, y, z = directions.unbind(-1)
    basis = [torch.full_like(x, 0.5 / math.sqrt(math.pi))]
    if count > 1:
        c = math.sqrt(3 / (4 * math.pi))
        basis += [-c * y, c * z, -c * x]
    if count > 4:
        xx, yy, zz = x * x, y * y, z * z
        c = 0.5 * math.sqrt(15 / math.pi)
        basis += [
            c * x * y,
            -c * y * z,
            0.25 * math.sqrt(5 / math.pi) * (2 * zz - xx - yy),
            -c * x * z,
            0.5 * c * (xx - yy),
        ]
    if count > 9:
        c1 = 0.25 * math.sqrt(21 / (2 * math.pi))
        c2 = 0.5 * math.sqrt(105 / math.pi)
        c3 = 0.25 * math.sqrt(35 / (2 * math.pi))
        basis += [
            -c3 * y * (3 * xx - yy),
            c2 * x * y * z,
            -c1 * y * (4 * zz - xx - yy),
            0.25 * math.sqrt(7 / math.pi) * z * (2 * zz - 3 * xx - 3 * yy),
            -c1 * x * (4 * zz - xx - yy),
            0.5 * c2 * z * (xx - yy),
            -c3 * x * (xx - 3 * yy),
        ]
    return torch.stack(basis, -1)


def sh_colors(
    sh: Float[Tensor, "*points K 3"], offsets: Float[Tensor, "*points 3"]
) -> Float[Tensor, "*points 3"]:
    """Return max(0, 0.5 + sum_k sh_k Y_k), seen along `offsets`.

    An offset is a mean minus the camera's center, of any length.
    """
    length = offsets.square().sum(-1, keepdim=True).clamp_min(TINY).sqrt()
    basis = sh_basis(offsets / length, sh.shape[-2])
    return (0.5 + (basis[..., None] * sh).sum(-2)).clamp_min(0)
