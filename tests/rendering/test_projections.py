"""Centers, conics and radii of splats, and the gradients of the centers."""

from dataclasses import replace

import pytest
import torch
from compiler import DEVICE, kernel

from asysplat import render
from asysplat.errors import InputError


def weighted_sum(image):
    weights = torch.linspace(-1, 1, image.numel(), dtype=torch.float64).to(image)
    return (image * weights.view_as(image)).sum()


def center_gradients(scene, backend, projections=True):
    gaussians, cameras = scene
    leaves = gaussians.map(lambda tensor: tensor.detach().requires_grad_())
    out = render(leaves, cameras, backend=backend, projections=projections)
    weighted_sum(out.image).backward()
    return out.projections, leaves


def test_a_center_is_where_the_camera_projects_it(make_scene):
    gaussians, cameras = make_scene(count=30, views=3)
    gaussians.opacities[:3] = 1e-4
    projections = render(gaussians, cameras, projections=True).projections
    pixels, _, _ = cameras.project(gaussians.means)
    visible = projections.radii > 0
    assert visible.any() and not visible[:, :3].any()
    assert torch.allclose(projections.means2d[visible], pixels[visible])
    assert not projections.means2d[~visible].any() and not projections.conics[~visible].any()


def test_conic_and_radius_are_those_of_a_sphere_on_the_axis(make_scene):
    gaussians, cameras = make_scene(count=1)
    cameras.cam_to_world.copy_(torch.eye(4))
    cameras.intrinsics[:, :2, :2] = 100 * torch.eye(2, dtype=torch.float64)
    gaussians.means.copy_(torch.tensor([[0.0, 0, 2]]))
    gaussians.scales.fill_(0.1)
    gaussians.opacities.fill_(0.9)
    projections = render(gaussians, cameras, projections=True).projections
    variance = (100 * 0.1 / 2) ** 2 + 0.3  # the dilation of 3DGS
    expected = torch.tensor([[[1 / variance, 0, 1 / variance]]], dtype=torch.float64)
    assert torch.allclose(projections.conics, expected)
    assert projections.radii.item() == pytest.approx(3 * variance**0.5)


def test_a_gradient_is_the_change_of_the_image_when_a_splat_moves(make_scene):
    """A small shift of a camera's principal point moves all centers alike."""
    gaussians, cameras = make_scene(count=40, views=2)
    # Outside, the principal point limits the tangents of the Jacobian too.
    inside = cameras.project(gaussians.means)[2].all(0)
    gaussians = gaussians.map(lambda field: field[inside])
    assert gaussians.num_gaussians > 10
    projections, _ = center_gradients((gaussians, cameras), "reference")
    for axis in range(2):
        losses = []
        for step in (-1e-6, 1e-6):
            intrinsics = cameras.intrinsics.clone()
            intrinsics[:, axis, 2] += step
            image = render(gaussians, replace(cameras, intrinsics=intrinsics)).image
            losses.append(weighted_sum(image).item())
        slope = (losses[1] - losses[0]) / 2e-6
        assert projections.means2d.grad[..., axis].sum().item() == pytest.approx(slope, rel=1e-5)


def check_backend(scene, backend, device="cpu"):
    exact, exact_leaves = center_gradients(scene, "reference")
    single = tuple(part.to(device, torch.float32) for part in scene)
    found, leaves = center_gradients(single, backend)
    assert found.means2d.grad.shape == found.means2d.shape
    error = (found.means2d.grad.cpu() - exact.means2d.grad).norm()
    assert 0 < error < 1e-4 * exact.means2d.grad.norm()
    assert torch.allclose(leaves.means.grad.cpu().double(), exact_leaves.means.grad, rtol=1e-3)
    assert torch.allclose(found.radii.cpu().double(), exact.radii, rtol=1e-4)


def test_the_cpu_backend_has_the_gradients_of_the_reference(make_scene):
    check_backend(make_scene(count=40, views=2, height=37, width=50), "cpu")
    # The gradients of the others keep their bits.
    scene = make_scene(count=40, views=2, dtype=torch.float32)
    (_, leaves), (_, others) = (center_gradients(scene, "cpu", asked) for asked in (True, False))
    assert torch.equal(leaves.means.grad, others.means.grad)
    assert torch.equal(leaves.sh.grad, others.sh.grad)


@kernel
def test_the_cuda_backend_has_the_gradients_of_the_reference(make_scene):
    check_backend(make_scene(count=20, views=2, height=20, width=35), "cuda", DEVICE)


def test_scenes_are_a_batch(make_scene):
    scenes = [make_scene(count=10, views=2, seed=seed) for seed in range(2)]
    gaussians, cameras = (type(parts[0]).stack(parts) for parts in zip(*scenes, strict=True))
    together = render(gaussians, cameras, projections=True).projections
    assert together.means2d.shape == (2, 2, 10, 2) and together.means2d.is_leaf
    alone = render(*scenes[1], projections=True).projections
    assert torch.equal(together.conics[1], alone.conics)


def test_views_at_once_is_refused_and_no_gradient_is_asked_for_without_one(make_scene):
    scene = make_scene(views=2)
    with pytest.raises(InputError, match="views_at_once is 1 and projections=True"):
        render(*scene, projections=True, views_at_once=1)
    assert render(*scene).projections is None
    with torch.no_grad():
        assert not render(*scene, projections=True).projections.means2d.requires_grad
