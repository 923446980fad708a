"""Spherical harmonics: orthonormal, with INRIA's signs, and rotated with their directions."""

import math

import pytest
import torch

from asysplat.geometry.spherical_harmonics import SH_C0, sh_basis, sh_colors, sh_rotation


def test_basis_is_orthonormal_on_the_sphere():
    # Midpoints in z and in the angle integrate degree 6 to the quadrature's error in z.
    z = (torch.arange(4000, dtype=torch.float64) + 0.5) / 2000 - 1
    angle = torch.arange(16, dtype=torch.float64) * (2 * math.pi / 16)
    radius = (1 - z * z).sqrt()[:, None]
    directions = torch.stack(
        (radius * angle.cos(), radius * angle.sin(), z[:, None].expand(-1, 16)), -1
    ).flatten(0, 1)
    basis = sh_basis(directions, 16)
    gram = 4 * math.pi * basis.T @ basis / len(basis)
    torch.testing.assert_close(gram, torch.eye(16, dtype=torch.float64), rtol=0, atol=1e-5)


def test_constants_and_signs_are_those_of_the_reference():
    x, y, z = 0.48, -0.6, 0.64
    xx, yy, zz = x * x, y * y, z * z
    # fmt: off
    expected = [
        0.28209479177387814,
        -0.4886025119029199 * y, 0.4886025119029199 * z, -0.4886025119029199 * x,
        1.0925484305920792 * x * y, -1.0925484305920792 * y * z,
        0.31539156525252005 * (2 * zz - xx - yy),
        -1.0925484305920792 * x * z, 0.5462742152960396 * (xx - yy),
        -0.5900435899266435 * y * (3 * xx - yy), 2.890611442640554 * x * y * z,
        -0.4570457994644658 * y * (4 * zz - xx - yy),
        0.3731763325901154 * z * (2 * zz - 3 * (xx + yy)),
        -0.4570457994644658 * x * (4 * zz - xx - yy), 1.445305721320277 * z * (xx - yy),
        -0.5900435899266435 * x * (xx - 3 * yy),
    ]
    # fmt: on
    expected = torch.tensor(expected, dtype=torch.float64)
    direction = torch.tensor([x, y, z], dtype=torch.float64)
    for count in (1, 4, 9, 16):
        torch.testing.assert_close(sh_basis(direction, count), expected[:count])


def test_colors_depend_on_the_direction_alone_and_are_not_negative():
    sh = torch.randn(5, 9, 3)
    offsets = torch.randn(5, 3)
    torch.testing.assert_close(sh_colors(sh, offsets), sh_colors(sh, 100 * offsets))
    assert (sh_colors(sh - 20 * torch.eye(9)[0, :, None], offsets) == 0).all()


def test_no_direction_gives_a_finite_color_and_gradient():
    sh = torch.randn(1, 4, 3)
    offsets = torch.zeros(1, 3, requires_grad=True)
    color = sh_colors(sh, offsets)
    torch.testing.assert_close(color, (0.5 + SH_C0 * sh[:, 0]).clamp_min(0))
    color.sum().backward()
    assert offsets.grad.isfinite().all()


@pytest.mark.parametrize("count", [1, 4, 9, 16])
def test_sh_turns_with_its_directions(count):
    skew = torch.randn(3, 3, dtype=torch.float64)
    rotation = torch.linalg.matrix_exp(skew - skew.mT)
    directions = torch.nn.functional.normalize(torch.randn(200, 3, dtype=torch.float64), dim=-1)
    sh = torch.eye(count, dtype=torch.float64)
    after = sh_basis(directions @ rotation.mT, count) @ sh_rotation(rotation, count) @ sh
    torch.testing.assert_close(after, sh_basis(directions, count) @ sh, atol=1e-12, rtol=0)
