"""Points, giants and needles."""

import math

import pytest
import torch
from backends import EXACT, assert_close, both_ways, facing, max_error, relative_error

from asysplat.rendering import INRIA
from asysplat.scene import Gaussians

NEEDLE = (1e3, 1e-4, 1e-4)


def one(scales, quat=(1.0, 0, 0, 0), mean=(0.01, 0.02, 3.0), opacity=0.8):
    return Gaussians(
        means=torch.tensor([mean]),
        quats=torch.tensor([quat]),
        scales=torch.tensor([scales]),
        opacities=torch.tensor([opacity]),
        sh=torch.tensor([[[0.3, -0.2, 0.1]]]),
    )


@pytest.mark.parametrize(
    "scales, antialiased", [((0.0, 0, 0), False), ((0.0, 0, 0), True), ((0.0, 0.1, 0.2), True)]
)
def test_scale_zero_has_finite_gradients(backend, make_scene, scales, antialiased):
    gaussians, cameras = make_scene(views=2, dtype=torch.float32)
    gaussians.scales[:] = torch.tensor(scales)
    result = both_ways(backend, gaussians, cameras, antialiased=antialiased)
    exact = both_ways(EXACT, gaussians, cameras, antialiased=antialiased)
    assert result.is_finite()
    if not antialiased:
        assert (result.alpha > 0).any()
    # The gradients of so few splats cancel in part.
    assert_close(backend, result, exact, slack=2)


def test_a_huge_scale_covers_the_screen(backend, make_scene):
    _, cameras = make_scene(views=2, dtype=torch.float32)
    result = both_ways(backend, one((1e10, 1e10, 1e10)), cameras)
    expected = torch.full((2, 13, 17), float(torch.tensor(0.8)), dtype=backend.dtype)
    torch.testing.assert_close(result.alpha, expected, rtol=0, atol=backend.image_error)
    assert result.is_finite()
    assert (result.grads["opacities"] != 0).all() and (result.grads["sh"] != 0).all()


def test_a_needle_at_45_degrees_has_the_right_conic(backend, make_scene):
    """Along its diagonal it has its opacity, and across it the width of the dilation alone."""
    _, cameras = make_scene(height=32, width=32, dtype=torch.float32)
    cameras = facing(cameras)
    cameras.intrinsics[:] = torch.tensor([[32.0, 0, 16.5], [0, 32, 16.5], [0, 0, 1]])
    turn = (math.cos(math.pi / 8), 0.0, 0.0, math.sin(math.pi / 8))
    needle = one(NEEDLE, turn, mean=(0.0, 0.0, 3.0))
    result = both_ways(backend, needle, cameras)
    at = torch.arange(32, dtype=torch.float64)
    across = (at[:, None] - at) / math.sqrt(2)
    expected = 0.8 * (-0.5 * across.square() / INRIA.eps2d).exp()
    expected[expected < INRIA.alpha_min] = 0
    assert max_error(result.alpha[0], expected) <= 2e-3
    assert result.is_finite()
    exact = both_ways(EXACT, needle, cameras)
    # The exponent grows by the length over the width: a rounding of the quaternion is seen.
    for name in ("means", "opacities", "sh", "background"):
        assert relative_error(result.grads[name], exact.grads[name]) <= 1e-2, name


@pytest.mark.parametrize("longest", [1e7, 1.0])
def test_no_alpha_exceeds_the_opacity(backend, make_scene, longest):
    """A negative exponent would: it is a sum of squares."""
    _, cameras = make_scene(height=16, width=16, dtype=torch.float32)
    count = 50
    generator = torch.Generator().manual_seed(1)
    needles = Gaussians(
        means=torch.rand(count, 1, 3, generator=generator) + torch.tensor([-0.5, -0.5, 2]),
        quats=torch.randn(count, 1, 4, generator=generator),
        scales=torch.tensor([longest, 1e-4, 1e-4]).expand(count, 1, 3),
        opacities=torch.full((count, 1), 0.5),
        sh=torch.zeros(count, 1, 1, 3),
    )
    cameras = cameras.map(lambda t: t.expand(count, *t.shape))
    result = both_ways(backend, needles, cameras)
    assert (result.alpha > 0.4).any()
    assert result.alpha.max() <= 0.5 * (1 + 1e-6)
    assert result.is_finite()
