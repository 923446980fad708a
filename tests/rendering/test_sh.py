"""Spherical harmonics: orthonormal, with INRIA's signs, and rotated with their directions."""

import math

import pytest
import torch

from asysplat.rendering.sh import SH_C0, sh_basis, sh_colors, sh_rotation


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
    expected = [
        0.28209479177387814,
        -0.4886025119029199 * y,
        0.4886025119029199 * z,
        -0.4886025119029199 * x,
        1.0925484305920792 * x * y,
        -1.0925484305920792 * y * z,
        0.31539156525252005 * (2 * z * z - x * x - y * y),
        -1.0925484305920792 * x * z,
        0.5462742152960396 * (x * x - y * y),
        -0.5900435899266435 * y * (3 * x * x - y * y),
        2.890611442640554 * x * y * z,
        -0.4570457994644658 * y * (4 * z * z - x * x - y * y),
        0.3731763325901154 * z * (2 * z * z - 3 * x * x - 3 * y * y),
        -0.4570457994644658 * x * (4 * z * z - x * x - y * y),
        1.445305721320277 * z * (x * x - y * y),
        -0.5900435899266435 * x * (x * x - 3 * y * y),
    ]
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


def random_rotation(seed: int) -> torch.Tensor:
    generator = torch.Generator().manual_seed(seed)
    skew = torch.randn(3, 3, generator=generator, dtype=torch.float64)
    return torch.linalg.matrix_exp(skew - skew.mT)


@pytest.mark.parametrize("count", [1, 4, 9, 16])
@pytest.mark.parametrize("seed", range(3))
def test_sh_turns_with_its_directions(count, seed):
    rotation = random_rotation(seed)
    directions = torch.nn.functional.normalize(torch.randn(200, 3, dtype=torch.float64), dim=-1)
    sh = torch.eye(count, dtype=torch.float64)
    turned = sh_rotation(rotation, count) @ sh
    before, after = (
        sh_basis(directions, count) @ sh,
        sh_basis(directions @ rotation.mT, count) @ turned,
    )
    torch.testing.assert_close(after, before, atol=1e-12, rtol=0)
