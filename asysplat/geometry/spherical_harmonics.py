"""Spherical harmonics (SH): the basis up to degree 3, its gradient, colors and rotations.

The functions have the signs of Kerbl et al. 2023 and INRIA's code: odd orders carry the
Condon-Shortley sign. Coefficients are ordered by degree l, then by order m from -l to l.
"""

import math

import torch
from jaxtyping import Float
from torch import Tensor

MIN_SQUARED_DISTANCE = 1e-20  # below the square of any distance that matters, and normal in float32
# Factors of the basis functions, by degree and order.
SH_C0 = 0.5 / math.sqrt(math.pi)  # a constant color is 0.5 + SH_C0 * sh_0
Y1 = math.sqrt(3 / (4 * math.pi))
Y2 = 0.5 * math.sqrt(15 / math.pi)
Y2_0 = 0.25 * math.sqrt(5 / math.pi)
Y3_3 = 0.25 * math.sqrt(35 / (2 * math.pi))
Y3_2 = 0.5 * math.sqrt(105 / math.pi)
Y3_1 = 0.25 * math.sqrt(21 / (2 * math.pi))
Y3_0 = 0.25 * math.sqrt(7 / math.pi)


def write_sh_basis(x, y, z, count, out):
    """Write the first `count` (1, 4, 9 or 16) SH functions at a unit direction to `out`.

    Numba compiles this function too; for Triton see `cuda.math.sh_basis`.
    """
    out[0] = SH_C0
    if count > 1:
        out[1] = -Y1 * y
        out[2] = Y1 * z
        out[3] = -Y1 * x
    if count > 4:
        xx, yy, zz = x * x, y * y, z * z
        out[4] = Y2 * x * y
        out[5] = -Y2 * y * z
        out[6] = Y2_0 * (2 * zz - xx - yy)
        out[7] = -Y2 * x * z
        out[8] = 0.5 * Y2 * (xx - yy)
        if count > 9:
            out[9] = -Y3_3 * y * (3 * xx - yy)
            out[10] = Y3_2 * x * y * z
            out[11] = -Y3_1 * y * (4 * zz - xx - yy)
            out[12] = Y3_0 * z * (2 * zz - 3 * xx - 3 * yy)
            out[13] = -Y3_1 * x * (4 * zz - xx - yy)
            out[14] = 0.5 * Y3_2 * z * (xx - yy)
            out[15] = -Y3_3 * x * (xx - 3 * yy)


def sh_basis_gradient(x, y, z, count, g):
    """Compute the gradient of x, y and z, as independent variables, from the gradients g."""
    gx = gy = gz = 0.0
    if count > 1:
        gx, gy, gz = -Y1 * g[3], -Y1 * g[1], Y1 * g[2]
    if count > 4:
        gx += Y2 * (y * g[4] - z * g[7] + x * g[8]) - 2 * Y2_0 * x * g[6]
        gy += Y2 * (x * g[4] - z * g[5] - y * g[8]) - 2 * Y2_0 * y * g[6]
        gz += -Y2 * (y * g[5] + x * g[7]) + 4 * Y2_0 * z * g[6]
    if count > 9:
        xx, yy, zz = x * x, y * y, z * z
        gx += -6 * Y3_3 * x * y * g[9] + Y3_2 * y * z * g[10] + 2 * Y3_1 * x * y * g[11]
        gx += -6 * Y3_0 * x * z * g[12] - Y3_1 * (4 * zz - 3 * xx - yy) * g[13]
        gx += Y3_2 * x * z * g[14] - 3 * Y3_3 * (xx - yy) * g[15]
        gy += -3 * Y3_3 * (xx - yy) * g[9] + Y3_2 * x * z * g[10]
        gy += -Y3_1 * (4 * zz - xx - 3 * yy) * g[11] - 6 * Y3_0 * y * z * g[12]
        gy += 2 * Y3_1 * x * y * g[13] - Y3_2 * y * z * g[14] + 6 * Y3_3 * x * y * g[15]
        gz += Y3_2 * x * y * g[10] - 8 * Y3_1 * y * z * g[11]
        gz += Y3_0 * (6 * zz - 3 * xx - 3 * yy) * g[12] - 8 * Y3_1 * x * z * g[13]
        gz += 0.5 * Y3_2 * (xx - yy) * g[14]
    return gx, gy, gz


def sh_basis(
    directions: Float[Tensor, "*points 3"], count: int
) -> Float[Tensor, "*points {count}"]:
    """Evaluate the first `count` (1, 4, 9 or 16) orthonormal SH functions at unit directions."""
    x, y, z = directions.unbind(-1)
    basis = [None] * count
    write_sh_basis(x, y, z, count, basis)
    return torch.stack((torch.full_like(x, basis[0]), *basis[1:]), -1)


def sh_colors(
    sh: Float[Tensor, "*points K 3"], offsets: Float[Tensor, "*points 3"]
) -> Float[Tensor, "*points 3"]:
    """Compute the colors max(0, 0.5 + sum_k sh_k Y_k) along `offsets`.

    An offset is a mean minus the camera's center, of any length.
    """
    length = offsets.square().sum(-1, keepdim=True).clamp_min(MIN_SQUARED_DISTANCE).sqrt()
    basis = sh_basis(offsets / length, sh.shape[-2])
    return (0.5 + (basis[..., None] * sh).sum(-2)).clamp_min(0)


def sh_rotation(rotation: Float[Tensor, "3 3"], count: int) -> Float[Tensor, "{count} {count}"]:
    """Compute the matrix that rotates `count` (1, 4, 9 or 16) SH coefficients.

    The rotated coefficients give the color along R d that the original ones give along d. A rotated
    SH function is a sum of SH functions of its degree, so its values in enough directions determine
    the matrix exactly.
    """
    # Directions nearly evenly over the sphere, on a Fibonacci spiral.
    index = torch.arange(2 * count, dtype=torch.float64) + 0.5
    z = 1 - index / count
    angle = index * torch.pi * (1 + 5**0.5)
    radius = (1 - z * z).sqrt()
    directions = torch.stack((radius * angle.cos(), radius * angle.sin(), z), -1).to(rotation)
    before = sh_basis(directions @ rotation, count)  # along R^-1 d
    return torch.linalg.pinv(sh_basis(directions, count)) @ before
