"""Gaussians of any extent, at any place, and with opacities at the cut-offs."""

import math
from dataclasses import replace

import pytest
import torch
from backends import (
    assert_exact,
    assert_same_bits,
    both_ways,
    facing,
    max_error,
    random_gradient,
)

from asysplat.geometry.spherical_harmonics import SH_C0, sh_basis
from asysplat.rendering import BLENDING_LIMITS, INRIA
from asysplat.scene import Cameras, Gaussians
from benchmarks.scenes import random_scene

CENTER = (4, 5)  # of the pixel that a stack stands at
per_limits = pytest.mark.parametrize("limits", BLENDING_LIMITS.values(), ids=BLENDING_LIMITS)


def stack(opacities, dtype=torch.float32):
    """Points of one pixel, one behind the other, dead center."""
    count = len(opacities)
    depths = torch.linspace(2, 3, count, dtype=dtype)
    gaussians = Gaussians(
        means=torch.stack((torch.zeros(count), torch.zeros(count), depths), -1),
        quats=torch.tensor([1.0, 0, 0, 0]).repeat(count, 1),
        scales=torch.full((count, 3), 0.01),
        opacities=torch.as_tensor(opacities),
        sh=torch.linspace(0, 1, count)[:, None, None].repeat(1, 1, 3),
    ).to(dtype)
    intrinsics = torch.tensor([[[20.0, 0, 5.5], [0, 20, 4.5], [0, 0, 1]]], dtype=dtype)
    return gaussians, Cameras(intrinsics, torch.eye(4, dtype=dtype)[None], 9, 11)


@pytest.mark.parametrize(
    "scales, antialiased", [((0.0, 0, 0), False), ((0.0, 0, 0), True), ((0.0, 0.1, 0.2), True)]
)
def test_scale_zero_has_the_gradients_of_the_reference(backend, make_scene, scales, antialiased):
    gaussians, cameras = make_scene(views=2, dtype=torch.float32)
    gaussians.scales[:] = torch.tensor(scales)
    # The gradients of so few splats cancel in part.
    result = assert_exact(backend, gaussians, cameras, slack=2, antialiased=antialiased)
    assert antialiased or (result.alpha > 0).any()


@pytest.mark.parametrize("scales", [(1e10,) * 3, (1e20,) * 3, (1e38,) * 3, (1e38, 1e-38, 1e-45)])
def test_huge_scales_are_finite_and_cover_the_screen(backend, make_scene, scales):
    gaussians, cameras = make_scene(count=1, views=2, dtype=torch.float32)
    gaussians.means[:] = torch.tensor([0.01, 0.02, 3.0])
    gaussians.scales[:] = torch.tensor(scales)
    assert both_ways(backend, gaussians, cameras, antialiased=True).is_finite()
    result = both_ways(backend, gaussians, cameras)
    assert result.is_finite()
    if scales[0] == 1e10:
        assert max_error(result.alpha, gaussians.opacities) <= backend.image_error
        assert (result.grads["opacities"] != 0).all() and (result.grads["sh"] != 0).all()


def test_no_alpha_exceeds_the_opacity(backend, make_scene):
    """A negative exponent would: it is a sum of squares."""
    _, cameras = make_scene(height=16, width=16, dtype=torch.float32)
    count = 50
    generator = torch.Generator().manual_seed(1)
    means = torch.rand(count, 1, 3, generator=generator) + torch.tensor([-0.5, -0.5, 2])
    quats = torch.randn(count, 1, 4, generator=generator)
    cameras = cameras.map(lambda t: t.expand(count, *t.shape))
    for longest in (1e7, 1.0):
        scales = torch.tensor([longest, 1e-4, 1e-4]).expand(count, 1, 3)
        opacities, sh = torch.full((count, 1), 0.5), torch.zeros(count, 1, 1, 3)
        result = both_ways(backend, Gaussians(means, quats, scales, opacities, sh), cameras)
        assert 0.4 < result.alpha.max() <= 0.5 * (1 + 1e-6)
        assert result.is_finite()


def test_no_direction_shows_the_dc_color(backend, make_scene):
    """At 1e-12 from the camera's center its direction is lost; near is 0, or it were culled."""
    gaussians, cameras = make_scene(count=1, degree=3, dtype=torch.float32)
    cameras = facing(cameras)
    gaussians.means[:] = torch.tensor([0.0, 0.0, 1e-12])
    gaussians.scales.fill_(1e-12)
    black, limits = torch.zeros(3), replace(INRIA, near=0.0)
    names = ("opacities", "sh")
    result = assert_exact(backend, gaussians, cameras, black, names=names, limits=limits)
    color = result.image[0, :, 7, 8] / result.alpha[0, 7, 8]
    dc = 0.5 + sh_basis(torch.zeros(3), 1) * gaussians.sh[0, 0]
    torch.testing.assert_close(color, dc.to(color.dtype), rtol=0, atol=0.02)


@pytest.mark.parametrize("aside, scale", [(0.01, 1.0), (1.0, 1.0), (100.0, 1e-3)])
def test_just_past_the_near_plane(backend, make_scene, aside, scale):
    gaussians, cameras = make_scene(dtype=torch.float32)
    gaussians.means[0] = torch.tensor([aside, -0.5 * aside, INRIA.near * 1.001])
    gaussians.scales[0] = scale
    assert_exact(backend, gaussians, facing(cameras), slack=5)


def test_far_from_the_origin_no_bit_changes(backend, make_scene):
    """On whole numbers, which float32 holds at 1e7 too."""
    gaussians, cameras = make_scene(count=40, views=2, dtype=torch.float32)
    gaussians = gaussians.scale_by(64.0)
    gaussians.means.round_()
    cameras.cam_to_world[..., :3, 3].mul_(64).round_()
    near = both_ways(backend, gaussians, cameras)
    gaussians.means.add_(1e7)
    cameras.cam_to_world[..., :3, 3].add_(1e7)
    assert (near.alpha > 0.3).any()
    assert_same_bits(both_ways(backend, gaussians, cameras), near)


@per_limits
@pytest.mark.parametrize("count, opacity", [(2, 1.0), (50, 0.9), (50, 1.0)])
def test_stacks_of_opaque_splats(backend, count, opacity, limits):
    """1 / (1 - alpha) does not blow up, and what lies behind the stop has no gradient."""
    gaussians, cameras = stack([opacity] * count)
    # Rounding, times 1 / (1 - alpha) < 100.
    result = assert_exact(backend, gaussians, cameras, slack=50, limits=limits)
    assert result.alpha.max() <= 1 - limits.transmittance_min * (1 - 1e-3)

    def center(_, output):
        grad = torch.zeros_like(output)
        grad[..., CENTER[0], CENTER[1]] = 1
        return grad

    result = both_ways(backend, gaussians, cameras, grad_output=center, limits=limits)
    assert (result.grads["sh"][0] != 0).all()
    assert (result.grads["sh"][10:] == 0).all() and (result.grads["opacities"][10:] == 0).all()


@per_limits
def test_a_single_opaque_gaussian_is_drawn(backend, limits):
    result = both_ways(backend, *stack([1.0]), limits=limits)
    row, column = CENTER
    assert float(result.alpha[0, row, column]) == pytest.approx(limits.alpha_max, abs=1e-6)
    beside = math.exp(-0.5 / (INRIA.eps2d + 0.01))
    assert float(result.alpha[0, row, column + 1]) == pytest.approx(beside, abs=1e-3)
    assert (result.grads["sh"] != 0).all() and (result.grads["means"] != 0).any()


def test_opacity_at_the_cut_off_is_exact(backend):
    """At 1/255 one pixel shows, at the next number below it none."""
    at = torch.tensor(INRIA.alpha_min, dtype=backend.dtype)
    below = torch.nextafter(at, torch.zeros_like(at))
    for opacity, pixels in ((at, 1), (below, 0)):
        result = both_ways(backend, *stack(opacity[None], backend.dtype))
        assert (result.alpha > 0).sum() == pixels
        assert float(result.alpha[0][CENTER]) == pytest.approx(pixels * float(opacity), rel=1e-6)
        assert (result.grads["opacities"] != 0).sum() == pixels


def test_both_passes_take_identical_decisions(backend):
    """Where colors are not clamped, an image is linear in them: gradient times colors is gradient
    times image. A pixel that only one pass draws adds more than 1/255 to the difference."""
    gaussians, cameras = random_scene(backend.many, 96, 128)
    gaussians = replace(gaussians, sh=gaussians.sh.abs())
    edges = torch.linspace(0.9999 / 255, 1.0001 / 255, backend.many // 3)
    gaussians.opacities[::3][: len(edges)] = edges  # many at a cut-off

    def grad_output(name, output):
        signs = random_gradient(name, output).sign()
        return signs if name == "image" else torch.zeros_like(output)

    result = both_ways(backend, gaussians, cameras, torch.zeros(3), grad_output, depth=False)
    by_colors = (result.grads["sh"].double() * (gaussians.sh.double() + 0.5 / SH_C0)).sum()
    by_image = (result.image.double() * grad_output("image", result.image)).sum()
    assert abs(float(by_colors - by_image)) < 0.1 / 255
