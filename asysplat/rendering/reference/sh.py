"""Colours from real spherical harmonics, degree 0 to 3, with the signs of INRIA's code."""

import math

import torch
from jaxtyping import Float
from torch import Tensor

TINY = 1e-20  # below the square of any distance that matters, and normal in float32


def sh_basis(
    directions: Float[Tensor, "*points 3"], count: int
) -> Float[Tensor, "*points {count}"]:
    """The first `count` (1, 4, 9 or 16) orthonormal basis functions at unit directions.

    Order: degree l, then m from -l to l. Odd m carry the Condon-Shortley sign, as in
    Kerbl et al. 2023.
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
    """max(0, 0.5 + sum_k sh_k Y_k), seen along `offsets`, mean minus camera centre, any length."""
    length = offsets.square().sum(-1, keepdim=True).clamp_min(TINY).sqrt()
    basis = sh_basis(offsets / length, sh.shape[-2])
    return (0.5 + (basis[..., None] * sh).sum(-2)).clamp_min(0)
