"""Poisoned buffers, types, strides, and unused outputs."""

from dataclasses import replace

import pytest
import torch
from backends import BACKGROUND, FIELDS, INPUTS, assert_same_bits, both_ways, ones
from poison import FILLS, poisoned

from asysplat.rendering import render
from asysplat.scene import Gaussians


@pytest.mark.parametrize("depth", ["expected", "median"])
def test_every_element_is_written(backend, make_scene, depth):
    gaussians, cameras = make_scene(count=60, views=3, height=33, width=35, dtype=torch.float32)
    gaussians.means[::2, 2] -= 10  # culled
    gaussians.opacities[1::4] = 1.0  # and opaque: some are behind the stop
    clean = both_ways(backend, gaussians, cameras, depth=depth)
    with poisoned(FILLS[0]):
        assert_same_bits(both_ways(backend, gaussians, cameras, depth=depth), clean)


@pytest.mark.parametrize(
    "dtype, autocast",
    [
        *[(torch.float16, None), (torch.bfloat16, torch.bfloat16), (torch.float32, torch.float16)],
        # It compiles the kernels for float64.
        pytest.param(torch.float64, torch.float16, marks=pytest.mark.slow),
    ],
    ids=str,
)
def test_inputs_of_any_type_are_computed_in_float32_at_least(backend, make_scene, dtype, autocast):
    gaussians, cameras = make_scene(views=2, dtype=dtype)
    background = BACKGROUND.to(dtype, copy=True)
    leaves = [getattr(gaussians, name) for name in FIELDS]
    leaves += [cameras.cam_to_world, cameras.intrinsics, background]
    for leaf in leaves:
        leaf.requires_grad_()
    with torch.autocast("cpu", dtype=autocast or torch.bfloat16, enabled=autocast is not None):
        out = render(gaussians, cameras, background, backend=backend.name)
    at_least = torch.promote_types(dtype, torch.float32)
    assert out.image.dtype == out.alpha.dtype == out.depth.dtype == at_least
    plain = replace(backend, dtype=at_least)
    result = both_ways(plain, gaussians, cameras, background, grad_output=ones)
    assert torch.equal(out.image, result.image)
    (out.image.sum() + out.alpha.sum() + out.depth.sum()).backward()
    for name, leaf in zip(INPUTS, leaves, strict=True):
        assert leaf.grad.dtype == dtype
        torch.testing.assert_close(leaf.grad, result.grads[name].to(dtype), msg=name)


def test_strided_and_expanded_inputs_and_gradients(backend, make_scene):
    gaussians, cameras = make_scene(count=12, views=3, dtype=torch.float32)
    gaussians.sh[:] = gaussians.sh[:1]
    gaussians.opacities[:] = 0.5
    cameras.intrinsics[:] = cameras.intrinsics[:1]
    plain = both_ways(backend, gaussians, cameras, grad_output=ones)

    def strided(tensor):
        return torch.stack((tensor, tensor), -1)[..., 0]

    leaves = {
        "means": strided(gaussians.means),
        "quats": gaussians.quats.flip(0),
        "scales": gaussians.scales.mT.contiguous(),
        "opacities": gaussians.opacities[:1],
        "sh": gaussians.sh[:1],
        "cam_to_world": strided(cameras.cam_to_world),
        "intrinsics": cameras.intrinsics[:1],
        "background": BACKGROUND,
    }
    leaves = {k: t.detach().to(backend.dtype).requires_grad_() for k, t in leaves.items()}
    means, quats, scales, opacities, sh, poses, intrinsics, background = leaves.values()
    scene = Gaussians(means, quats.flip(0), scales.mT, opacities.expand(12), sh.expand(12, -1, -1))
    views = replace(cameras, cam_to_world=poses, intrinsics=intrinsics.expand(3, 3, 3))
    out = render(scene, views, background.expand(3, 3), backend.name)
    torch.testing.assert_close(out.image, plain.image, rtol=0, atol=1e-6)
    # Strides of an image that lies [W, H, 3] in memory, and of numbers that are all the same.
    one = torch.ones((), dtype=backend.dtype)
    grads = torch.autograd.grad(
        [out.image, out.alpha, out.depth],
        list(leaves.values()),
        [torch.ones_like(out.image.mT.contiguous()).mT, *[one.expand_as(out.alpha)] * 2],
    )
    expected = dict(plain.grads)
    expected["quats"] = expected["quats"].flip(0)
    expected["scales"] = expected["scales"].mT
    for name, grad in zip(INPUTS, grads, strict=True):
        torch.testing.assert_close(
            grad, expected[name].sum_to_size(grad.shape), rtol=1e-4, atol=1e-4, msg=name
        )


@pytest.mark.parametrize(
    "used, depth",
    [
        *[("image", "expected"), ("alpha", "median")],
        *[("depth", "expected"), ("depth", "median"), ("depth", "accumulated")],
    ],
)
def test_the_gradient_of_one_output_is_that_of_all_with_zeros(backend, make_scene, used, depth):
    scene = make_scene(views=2, dtype=torch.float32)

    def zeros(name, output):
        return torch.full_like(output, float(name == used))

    def alone(name, output):
        return torch.ones_like(output) if name == used else None

    expected = both_ways(backend, *scene, grad_output=zeros, depth=depth)
    result = both_ways(backend, *scene, grad_output=alone, depth=depth)
    for name in INPUTS:
        torch.testing.assert_close(
            result.grads[name], expected.grads[name], rtol=1e-5, atol=1e-5, msg=name
        )


def test_each_input_alone_or_none_needs_a_gradient(backend, make_scene):
    scene = make_scene(views=2, dtype=torch.float32)
    expected = both_ways(backend, *scene, grad_output=ones)
    for name in INPUTS:
        result = both_ways(backend, *scene, grad_output=ones, inputs=(name,))
        assert torch.equal(result.grads[name], expected.grads[name]), name
    gaussians, cameras = (part.to(backend.dtype) for part in scene)
    assert not render(gaussians, cameras, backend=backend.name).image.requires_grad
