"""The reference renderer against a per-pixel loop and against what can be said by hand."""

import math
from dataclasses import replace

import pytest
import torch

from asysplat.errors import InputError
from asysplat.rendering import INRIA, render
from asysplat.rendering.reference import rasterize
from asysplat.scene import Cameras, Gaussians


def pixel_loop(gaussians, cameras, background):
    """One view, one pixel after the other, by the textbook formulas; image, alpha, depth."""
    (fx, _, cx), (_, fy, cy), _ = cameras.intrinsics[0].tolist()
    width, height = cameras.width, cameras.height
    rotation, center = cameras.cam_to_world[0, :3, :3], cameras.cam_to_world[0, :3, 3]
    splats = []
    for mean, quat, scale, opacity, sh in zip(
        gaussians.means,
        gaussians.quats,
        gaussians.scales,
        gaussians.opacities,
        gaussians.sh,
        strict=True,
    ):
        x, y, z = (rotation.T @ (mean - center)).tolist()
        w, i, j, k = (quat / quat.norm()).tolist()
        cross = torch.tensor([[0, -k, j], [k, 0, -i], [-j, i, 0]], dtype=torch.float64)
        turn = torch.eye(3, dtype=torch.float64) + 2 * w * cross + 2 * cross @ cross
        sigma = turn @ torch.diag(scale**2) @ turn.T
        inside_x = min(max(x / z, (-cx - 0.15 * width) / fx), (1.15 * width - cx) / fx)
        inside_y = min(max(y / z, (-cy - 0.15 * height) / fy), (1.15 * height - cy) / fy)
        jacobian = [[fx / z, 0, -fx * inside_x / z], [0, fy / z, -fy * inside_y / z]]
        jacobian = torch.tensor(jacobian, dtype=torch.float64) @ rotation.T
        conic = torch.linalg.inv(jacobian @ sigma @ jacobian.T + 0.3 * torch.eye(2).double())
        dx, dy, dz = ((mean - center) / (mean - center).norm()).tolist()
        basis = [0.28209479177387814] + [0.4886025119029199 * d for d in (-dy, dz, -dx)]
        color = (0.5 + sum(b * c for b, c in zip(basis, sh, strict=True))).clamp(min=0)
        splats.append((z, fx * x / z + cx, fy * y / z + cy, conic, opacity, color))
    splats.sort(key=lambda splat: splat[0])

    image, alphas, depths = torch.zeros(5, height, width).double().split((3, 1, 1))
    alphas, depths = alphas[0], depths[0]
    for row in range(height):
        for column in range(width):
            left, depth = 1.0, 0.0
            for z, u, v, conic, opacity, color in splats:
                d = torch.tensor([column + 0.5 - u, row + 0.5 - v], dtype=torch.float64)
                alpha = min(INRIA.alpha_max, float(opacity * torch.exp(-0.5 * d @ conic @ d)))
                if alpha < INRIA.alpha_min:
                    continue
                if left * (1 - alpha) < INRIA.transmittance_min:
                    break
                image[:, row, column] += left * alpha * color
                depth += left * alpha * z
                left *= 1 - alpha
            image[:, row, column] += left * background
            alphas[row, column] = 1 - left
            depths[row, column] = depth / (1 - left) if left < 1 else 0
    return image, alphas, depths


@pytest.mark.parametrize("height, width", [(1, 1), (1, 40), (17, 31), (13, 17)])
@pytest.mark.parametrize("opaque", [False, True])
def test_matches_a_loop_over_pixels(make_scene, opaque, height, width):
    gaussians, cameras = make_scene(height=height, width=width)
    if opaque:  # so that clamping and the early stop are met
        gaussians.opacities.fill_(0.9999)
        gaussians.scales.mul_(3)
    background = torch.tensor([0.2, 0.5, 0.9], dtype=torch.float64)
    image, alpha, depth = pixel_loop(gaussians, cameras, background)
    out = render(gaussians, cameras, background)
    assert alpha.max() > (0.999 if opaque else 0.4)
    torch.testing.assert_close(out.image[0], image, rtol=0, atol=1e-9)
    torch.testing.assert_close(out.alpha[0], alpha, rtol=0, atol=1e-9)
    torch.testing.assert_close(out.depth[0], depth, rtol=0, atol=1e-9)


def test_one_gaussian_at_its_center():
    gaussians = Gaussians(
        means=torch.tensor([[0.5, 0.5, 2.0]]),  # projects to the center of pixel (5, 5)
        quats=torch.tensor([[2.0, 0, 0, 0]]),
        scales=torch.tensor([[0.1, 0.2, 0.3]]),
        opacities=torch.tensor([0.6]),
        sh=torch.tensor([[[1.0, 0, -1]]]),
    )
    intrinsics = torch.tensor([[[2.0, 0, 5], [0, 2, 5], [0, 0, 1]]])
    cameras = Cameras(intrinsics, torch.eye(4)[None], 9, 9)
    out = render(gaussians, cameras, torch.ones(3))
    dc = 0.5 / math.sqrt(math.pi)
    color = torch.tensor([0.5 + dc, 0.5, 0.5 - dc])
    torch.testing.assert_close(out.alpha[0, 5, 5], torch.tensor(0.6))
    torch.testing.assert_close(out.image[0, :, 5, 5], 0.6 * color + 0.4)
    torch.testing.assert_close(out.depth[0, 5, 5], torch.tensor(2.0))
    # One pixel to the right; J = f/z (1, 0, -x/z).
    variance = 0.1**2 + (0.25 * 0.3) ** 2 + 0.3
    covariance = 0.25 * 0.25 * 0.3**2
    other = 0.2**2 + (0.25 * 0.3) ** 2 + 0.3
    sigma = other / (variance * other - covariance**2) / 2
    torch.testing.assert_close(out.alpha[0, 5, 6], torch.tensor(0.6 * math.exp(-sigma)))


def test_batches_and_views_equal_single_renders(make_scene):
    scenes = [make_scene(views=3, dtype=torch.float32, seed=seed) for seed in range(4)]
    gaussians = Gaussians.stack([scene for scene, _ in scenes])
    cameras = Cameras.stack([views for _, views in scenes])
    background = torch.rand(2, 2, 3, 3)
    out = render(
        gaussians.map(lambda t: t.unflatten(0, (2, 2))),
        cameras.map(lambda t: t.unflatten(0, (2, 2))),
        background,
    )
    assert out.image.shape == (2, 2, 3, 3, 13, 17) and out.depth.shape == (2, 2, 3, 13, 17)
    for index, (scene, views) in enumerate(scenes):
        b, c = divmod(index, 2)
        for view in range(3):
            alone = render(scene, views.select([view]), background[b, c, view])
            torch.testing.assert_close(out.image[b, c, view], alone.image[0])
            torch.testing.assert_close(out.depth[b, c, view], alone.depth[0])


def test_order_of_gaussians_does_not_matter(make_scene):
    gaussians, cameras = make_scene(count=40)
    order = torch.randperm(40)
    shuffled = render(gaussians.map(lambda t: t[order]), cameras)
    torch.testing.assert_close(shuffled.image, render(gaussians, cameras).image)


def test_equal_depths_are_drawn_in_the_order_of_their_index(make_scene):
    gaussians, cameras = make_scene(count=2)
    gaussians = gaussians.map(lambda t: t[:1].repeat(2, *(1,) * (t.ndim - 1)))
    gaussians.sh[1] = 1
    alone = render(gaussians.map(lambda t: t[:1]), cameras)
    both = render(gaussians, cameras)
    behind = render(gaussians.map(lambda t: t[1:]), cameras)
    expected = alone.image + (1 - alone.alpha) * behind.image
    torch.testing.assert_close(both.image, expected)


def test_any_tiles_and_groups_give_the_same_image(make_scene, monkeypatch):
    gaussians, cameras = make_scene(count=60, views=2, height=19)

    def run():
        means = gaussians.means.clone().requires_grad_()
        out = render(replace(gaussians, means=means), cameras)
        return out.image, *torch.autograd.grad(out.image.square().sum(), means)

    before = run()
    monkeypatch.setattr(rasterize, "GROUP_ELEMENTS", 1)
    torch.testing.assert_close(run(), before)
    monkeypatch.setattr(rasterize, "TILE", 7)
    torch.testing.assert_close(run(), before)


def test_depth_is_optional(make_scene):
    gaussians, cameras = make_scene()
    out = render(gaussians, cameras, depth=False)
    assert out.depth is None
    torch.testing.assert_close(out.image, render(gaussians, cameras).image)


def test_errors_say_what_to_do(make_scene):
    gaussians, cameras = make_scene()
    with pytest.raises(InputError, match=r"'fast'.*auto, reference"):
        render(gaussians, cameras, backend="fast")
    with pytest.raises(InputError, match=r"\(2,\).*\(\)"):
        render(gaussians.map(lambda t: torch.stack((t, t))), cameras)
    with pytest.raises(InputError, match=r"\(1,\).*\(3,\) or \(1, 3\)"):
        render(gaussians, cameras, torch.ones(1, dtype=torch.float64))
