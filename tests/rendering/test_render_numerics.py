"""Scenes that other renderers get wrong: far away, thin, huge, in half precision."""

import math

import pytest
import torch

from asysplat.rendering import render
from asysplat.scene import Cameras, Gaussians

GAUSSIAN_FIELDS = ("means", "quats", "scales", "opacities", "sh")


def test_far_from_the_origin_in_float32(make_scene):
    gaussians, cameras = make_scene(count=40, views=2, dtype=torch.float32)
    # On a grid that float32 holds at 1e5 too, so that the two scenes are the same.
    gaussians.means.mul_(64).round_().div_(64)
    cameras.cam_to_world[..., :3, 3].mul_(64).round_().div_(64)
    near = render(gaussians, cameras)
    gaussians.means.add_(131072.0)
    cameras.cam_to_world[..., :3, 3].add_(131072.0)
    torch.testing.assert_close(render(gaussians, cameras).image, near.image, rtol=0, atol=1e-6)


@pytest.mark.parametrize("dtype", [torch.float16, torch.bfloat16])
def test_half_precision_is_computed_in_float32(make_scene, dtype):
    gaussians, cameras = make_scene(dtype=dtype)
    gaussians.map(lambda t: t.requires_grad_())
    with torch.autocast("cpu", dtype=torch.bfloat16):
        out = render(gaussians, cameras)
    assert out.image.dtype == torch.float32
    assert torch.equal(
        out.image, render(gaussians.to(torch.float32), cameras.to(torch.float32)).image
    )
    out.image.sum().backward()
    assert gaussians.means.grad.dtype == dtype and gaussians.means.grad.isfinite().all()


def test_a_needle_has_the_alpha_of_float64(make_scene):
    _, cameras = make_scene(count=1, views=1, height=32, width=32)
    needle = Gaussians(
        means=torch.tensor([[0.01, 0.02, 3.0]]),
        quats=torch.tensor([[math.cos(math.pi / 8), 0, 0, math.sin(math.pi / 8)]]),
        scales=torch.tensor([[1e3, 1e-4, 1e-4]]),
        opacities=torch.tensor([0.8]),
        sh=torch.zeros(1, 1, 3),
    )
    cameras = Cameras(cameras.intrinsics, torch.eye(4, dtype=torch.float64)[None], 32, 32)
    exact = render(needle.to(torch.float64), cameras).alpha
    assert (exact > 0.5).sum() > 30  # it crosses the image
    alpha = render(needle, cameras.to(torch.float32)).alpha
    torch.testing.assert_close(alpha.double(), exact, rtol=0, atol=2e-3)


def test_a_huge_gaussian_covers_the_screen(make_scene):
    gaussians, cameras = make_scene(count=1, dtype=torch.float32)
    gaussians.scales.fill_(1e10)
    gaussians.map(lambda t: t.requires_grad_())
    out = render(gaussians, cameras)
    torch.testing.assert_close(out.alpha, gaussians.opacities.detach().expand(1, 13, 17))
    out.image.sum().backward()
    assert all(getattr(gaussians, name).grad.isfinite().all() for name in GAUSSIAN_FIELDS)


def test_the_unit_of_length_does_not_matter(make_scene):
    gaussians, cameras = make_scene(dtype=torch.float32)
    before = render(gaussians, cameras)
    cameras.cam_to_world[:, :3, 3] *= 8
    after = render(gaussians.scale_by(8.0), cameras)
    torch.testing.assert_close(after.image, before.image, rtol=0, atol=1e-6)
    torch.testing.assert_close(after.depth, 8 * before.depth)
