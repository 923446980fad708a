"""Gradients against finite differences, and every backend against the reference, in every mode."""

from dataclasses import replace

import pytest
import torch
from backends import BACKGROUND, FIELDS, assert_exact, random_gradient

from asysplat.rendering import INRIA, render
from asysplat.scene import Gaussians

# So wide a dilation that small splats still reach every pixel; half of the opacity is left.
FLOOR = replace(INRIA, eps2d=8.0, compensation_min=0.25)
MODES = {  # options of `render`; the degree of SH, and how wide the Gaussians are
    "expected": ({}, 1, 5.0),
    "accumulated": ({"depth": "accumulated"}, 1, 5.0),
    "median": ({"depth": "median"}, 1, 5.0),
    "antialiased": ({"antialiased": True}, 1, 5.0),
    "antialiased, below the floor": ({"antialiased": True, "limits": FLOOR}, 1, 0.2),
    "antialiased, above the floor": ({"antialiased": True, "limits": FLOOR}, 1, 5.0),
    "degree 3": ({}, 3, 5.0),
}


@pytest.fixture(params=MODES)
def soft_scene(make_scene, request):
    """Wide Gaussians on few pixels, no alpha near a cut-off, no color near 0; and options."""
    options, degree, width = MODES[request.param]
    gaussians, cameras = make_scene(3, 2, 5, 6, degree)
    gaussians.means[:, :2] *= 0.2
    gaussians.scales.mul_(width)
    gaussians.sh.mul_(0.3)
    return gaussians, cameras, options


def test_every_gradient_equals_finite_differences(soft_scene):
    gaussians, cameras, options = soft_scene
    leaves = [getattr(gaussians, name) for name in FIELDS]
    leaves += [cameras.cam_to_world, cameras.intrinsics, BACKGROUND]
    leaves = [leaf.clone().requires_grad_() for leaf in leaves]

    def outputs(*leaves):
        *fields, poses, intrinsics, background = leaves
        views = replace(cameras, cam_to_world=poses, intrinsics=intrinsics)
        out = render(Gaussians(*fields), views, background, **options)
        outputs = {"image": out.image, "alpha": out.alpha, "depth": out.depth}
        return tuple((t * random_gradient(name, t)).sum((-1, -2)) for name, t in outputs.items())

    assert torch.autograd.gradcheck(outputs, leaves, atol=1e-7, fast_mode=True)


def test_every_gradient_equals_that_of_the_reference(fast_backend, soft_scene):
    gaussians, cameras, options = soft_scene
    assert_exact(fast_backend, gaussians.to(torch.float32), cameras.to(torch.float32), **options)


@pytest.mark.parametrize("scale", [1e-4, 0.1], ids="{:g} pixels".format)
def test_the_floor_of_the_compensation(backend, make_scene, scale):
    """Under it the opacity stays at the floor, and scales move nothing but the ellipse."""
    gaussians, cameras = make_scene(count=1, dtype=torch.float32)
    gaussians.means[:] = torch.tensor([0.0, 0, 2])
    gaussians.scales.fill_(scale * 2 / 17)
    gaussians.opacities.fill_(1.0)
    cameras.cam_to_world[:] = torch.eye(4)
    cameras.intrinsics[:] = torch.tensor([[17.0, 0, 8.5], [0, 17, 6.5], [0, 0, 1]])

    def grad_output(name, output):  # all gradients of one sign, so that none cancel
        return torch.full_like(output, float(name == "alpha"))

    names = ("scales", "opacities")
    result = assert_exact(
        backend, gaussians, cameras, grad_output=grad_output, names=names, antialiased=True
    )
    share = max(scale**4 / (scale**2 + INRIA.eps2d) ** 2, INRIA.compensation_min)
    assert float(result.alpha[0, 6, 8]) == pytest.approx(share**0.5, rel=1e-5)
