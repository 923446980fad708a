"""Gradients of the reference renderer: right, zero where nothing is seen, the same every time."""

import pytest
import torch

from asysplat.rendering import render
from asysplat.scene import Cameras, Gaussians

GAUSSIAN_FIELDS = ("means", "quats", "scales", "opacities", "sh")
INPUTS = (*GAUSSIAN_FIELDS, "cam_to_world", "intrinsics", "background")


@pytest.mark.parametrize("name", INPUTS)
def test_gradients_equal_finite_differences(make_scene, name):
    # Wide Gaussians on few pixels, so that no alpha comes near a jump at 1/255 or .99.
    gaussians, cameras = make_scene(count=4, views=2, height=5, width=6)
    gaussians = Gaussians(
        gaussians.means * torch.tensor([0.2, 0.2, 1], dtype=torch.float64),
        gaussians.quats,
        gaussians.scales * 5,
        gaussians.opacities,
        gaussians.sh * 0.5,
    )
    single = [render(gaussians.keep(torch.arange(4) == i), cameras) for i in range(4)]
    alphas = torch.stack([out.alpha for out in single])
    assert alphas.min() > 1.1 / 255 and alphas.max() < 0.9
    assert (1 - alphas).prod(0).min() > 1e-3
    assert all((out.image / out.alpha[:, None]).min() > 0.05 for out in single)  # colours

    tensors = {
        "means": gaussians.means,
        "quats": gaussians.quats,
        "scales": gaussians.scales,
        "opacities": gaussians.opacities,
        "sh": gaussians.sh,
        "cam_to_world": cameras.cam_to_world,
        "intrinsics": cameras.intrinsics,
        "background": torch.rand(2, 3, dtype=torch.float64),
    }

    weights = torch.randn(3, 5, 6, dtype=torch.float64)

    def outputs(tensor):
        now = {**tensors, name: tensor}
        out = render(
            Gaussians(*(now[field] for field in GAUSSIAN_FIELDS)),
            Cameras(now["intrinsics"], now["cam_to_world"], cameras.height, cameras.width),
            now["background"],
        )
        return tuple(
            (image * weight).sum((-1, -2))
            for image, weight in zip((out.image, out.alpha, out.depth), weights, strict=True)
        )

    assert torch.autograd.gradcheck(outputs, tensors[name].clone().requires_grad_(), atol=1e-7)


@pytest.mark.parametrize("keep", [0, 12])
def test_nothing_to_see_gives_the_background(make_scene, keep):
    gaussians, cameras = make_scene(views=2)
    gaussians = gaussians.map(lambda t: t[:keep])
    gaussians.means[:, 2] -= 20
    background = torch.tensor([0.1, 0.2, 0.3], dtype=torch.float64, requires_grad=True)
    gaussians.map(lambda t: t.requires_grad_())
    out = render(gaussians, cameras, background)
    assert (out.image == background[:, None, None]).all()
    assert (out.alpha == 0).all() and (out.depth == 0).all()
    assert out.stats["visible"] == 0 and out.stats["pairs"] == 0
    out.image.sum().backward()
    assert all((getattr(gaussians, name).grad == 0).all() for name in GAUSSIAN_FIELDS)
    assert (background.grad == 2 * 13 * 17).all()


def test_unusable_gaussians_are_culled_and_get_no_gradient(make_scene):
    gaussians, cameras = make_scene(count=12)
    cameras = Cameras(cameras.intrinsics, torch.eye(4, dtype=torch.float64)[None], 13, 17)
    clean = render(gaussians.map(lambda t: t[8:]), cameras)
    gaussians.means[:3] = torch.tensor([[0, 0, 0], [0.3, 0, 0], [0.1, 0.1, -2]])
    gaussians.means[3, 0] = torch.nan
    gaussians.scales[4] = torch.inf
    gaussians.quats[5] = 0
    gaussians.opacities[6] = 0.003
    gaussians.sh[7, 1] = -torch.inf
    gaussians.map(lambda t: t.requires_grad_())
    out = render(gaussians, cameras)
    assert torch.equal(out.image, clean.image)
    (out.image.sum() + out.depth.sum()).backward()
    for name in GAUSSIAN_FIELDS:
        grad = getattr(gaussians, name).grad
        assert (grad[:8] == 0).all() and grad[8:].isfinite().all() and (grad[8:] != 0).any()


def test_any_number_of_threads_gives_the_same_bits(make_scene):
    gaussians, cameras = make_scene(
        count=3000, views=4, height=48, width=48, degree=3, dtype=torch.float32
    )
    leaves = [getattr(gaussians, name) for name in GAUSSIAN_FIELDS]
    leaves = [leaf.requires_grad_() for leaf in (*leaves, cameras.cam_to_world, cameras.intrinsics)]

    def run(threads):
        torch.set_num_threads(threads)
        out = render(gaussians, cameras)
        return (out.image, *torch.autograd.grad(out.image.square().sum() + out.depth.sum(), leaves))

    threads = torch.get_num_threads()
    try:
        runs = [run(1), run(2), run(2)]
    finally:
        torch.set_num_threads(threads)
    for first, *others in zip(*runs, strict=True):
        assert all(torch.equal(first, other) for other in others)
