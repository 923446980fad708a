"""Gaussians at the camera, at its near plane and far from the origin."""

from dataclasses import replace

import pytest
import torch
from backends import EXACT, assert_close, assert_same_bits, both_ways, facing, relative_error

from asysplat.geometry.spherical_harmonics import sh_basis
from asysplat.rendering import INRIA


def test_no_direction_shows_the_dc_color(backend, make_scene):
    """At 1e-12 from the camera's center its direction is lost; near is 0, or it were culled."""
    gaussians, cameras = make_scene(count=1, degree=3, dtype=torch.float32)
    cameras = facing(cameras)
    gaussians.means[:] = torch.tensor([0.0, 0.0, 1e-12])
    gaussians.scales.fill_(1e-12)
    limits = replace(INRIA, near=0.0)
    result = both_ways(backend, gaussians, cameras, 0 * gaussians.means[0], limits=limits)
    assert result.is_finite()
    color = result.image[0, :, 7, 8] / result.alpha[0, 7, 8]
    dc = 0.5 + sh_basis(torch.zeros(3), 1) * gaussians.sh[0, 0]
    torch.testing.assert_close(color, dc.to(color.dtype), rtol=0, atol=0.02)
    exact = both_ways(EXACT, gaussians, cameras, 0 * gaussians.means[0], limits=limits)
    assert_close(backend, result, exact, names=("opacities", "sh"))


@pytest.mark.parametrize("aside, scale", [(0.01, 1.0), (1.0, 1.0), (100.0, 1e-3)])
def test_just_past_the_near_plane(backend, make_scene, aside, scale):
    gaussians, cameras = make_scene(dtype=torch.float32)
    gaussians.means[0] = torch.tensor([aside, -0.5 * aside, INRIA.near * 1.001])
    gaussians.scales[0] = scale
    result = both_ways(backend, gaussians, facing(cameras))
    assert result.is_finite()
    assert_close(backend, result, both_ways(EXACT, gaussians, facing(cameras)), slack=5)


def test_far_from_the_origin_no_bit_changes(backend, make_scene):
    """On whole numbers, which float32 holds at 1e7 too: the scene is the same, and so is every bit
    of the images and of the gradients."""
    gaussians, cameras = make_scene(count=40, views=2, dtype=torch.float32)
    gaussians = gaussians.scale_by(64.0)
    gaussians.means.round_()
    cameras.cam_to_world[..., :3, 3].mul_(64).round_()
    near = both_ways(backend, gaussians, cameras)
    gaussians.means.add_(1e7)
    cameras.cam_to_world[..., :3, 3].add_(1e7)
    far = both_ways(backend, gaussians, cameras)
    assert (near.alpha > 0.3).any()
    assert_same_bits(far, near)


@pytest.mark.parametrize("factor", [1e-4, 1e4])
def test_the_unit_of_length_does_not_matter(backend, make_scene, factor):
    gaussians, cameras = make_scene(views=2)
    before = both_ways(backend, gaussians, cameras, depth=False)
    cameras.cam_to_world[:, :3, 3] *= factor
    limits = replace(INRIA, near=INRIA.near * factor)
    after = both_ways(backend, gaussians.scale_by(factor), cameras, depth=False, limits=limits)
    torch.testing.assert_close(after.image, before.image, rtol=0, atol=1e-6)
    for name, grad in before.grads.items():
        if name != "cam_to_world":
            own = after.grads[name] * (factor if name in ("means", "scales") else 1)
            assert relative_error(own, grad) <= 1e-5, name
