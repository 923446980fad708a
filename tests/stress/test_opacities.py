"""Opacities at the cut-offs."""

import math
from dataclasses import replace

import pytest
import torch
from backends import EXACT, assert_close, both_ways, random_gradient

from asysplat.geometry.spherical_harmonics import SH_C0
from asysplat.rendering import BLENDING_LIMITS, INRIA
from asysplat.scene import Cameras, Gaussians
from benchmarks.scenes import random_scene

CENTER = (4, 5)  # of the pixel that the stack stands at


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


@pytest.mark.parametrize("limits", BLENDING_LIMITS)
@pytest.mark.parametrize("count, opacity", [(2, 1.0), (50, 0.9), (50, 1.0)])
def test_stacks_of_opaque_splats(backend, count, opacity, limits):
    """1 / (1 - alpha) does not blow up, and what lies behind the stop has no gradient."""
    gaussians, cameras = stack([opacity] * count)
    limits = BLENDING_LIMITS[limits]
    result = both_ways(backend, gaussians, cameras, limits=limits)
    assert result.is_finite()
    exact = both_ways(EXACT, gaussians, cameras, limits=limits)
    assert_close(backend, result, exact, slack=50)  # rounding, times 1 / (1 - alpha) < 100
    assert result.alpha.max() <= 1 - limits.transmittance_min * (1 - 1e-3)

    def center(_, output):
        grad = torch.zeros_like(output)
        grad[..., CENTER[0], CENTER[1]] = 1
        return grad

    result = both_ways(backend, gaussians, cameras, grad_output=center, limits=limits)
    assert (result.grads["sh"][0] != 0).all()
    assert (result.grads["sh"][10:] == 0).all() and (result.grads["opacities"][10:] == 0).all()


@pytest.mark.parametrize("limits", BLENDING_LIMITS)
def test_a_single_opaque_gaussian_is_drawn(backend, limits):
    gaussians, cameras = stack([1.0])
    limits = BLENDING_LIMITS[limits]
    result = both_ways(backend, gaussians, cameras, limits=limits)
    row, column = CENTER
    assert float(result.alpha[0, row, column]) == pytest.approx(limits.alpha_max, abs=1e-6)
    beside = math.exp(-0.5 / (INRIA.eps2d + 0.01))
    assert float(result.alpha[0, row, column + 1]) == pytest.approx(beside, abs=1e-3)
    assert (result.grads["sh"] != 0).all() and (result.grads["means"] != 0).any()


def test_opacity_at_the_cut_off_is_exact(backend):
    """At 1/255 one pixel shows, at the next number below it none."""
    row, column = CENTER
    at = torch.tensor(INRIA.alpha_min, dtype=backend.dtype)
    below = torch.nextafter(at, torch.zeros_like(at))
    for opacity, pixels in ((at, 1), (below, 0)):
        gaussians, cameras = stack(opacity[None], backend.dtype)
        result = both_ways(backend, gaussians, cameras)
        assert (result.alpha > 0).sum() == pixels
        assert float(result.alpha[0, row, column]) == pytest.approx(
            pixels * float(opacity), rel=1e-6
        )
        assert (result.grads["opacities"] != 0).sum() == pixels


def test_both_passes_take_identical_decisions(backend):
    """Where colors are not clamped, an image is linear in them: gradient times colors is gradient
    times image. A pixel that one pass draws and the other does not adds more than 1/255 to the
    difference."""
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
