"""The reference renderer against a per-pixel loop, analytic values and finite differences."""

import math
from dataclasses import replace

import pytest
import torch

from asysplat.errors import InputError
from asysplat.rendering import render
from asysplat.rendering.rasterize import reference
from asysplat.scene import Cameras, Gaussians

INPUTS = ("means", "quats", "scales", "opacities", "sh", "cam_to_world", "intrinsics", "background")


def make_scene(count=12, views=1, height=13, width=17, degree=1, dtype=torch.float64, seed=0):
    """Gaussians of about 2 pixels in front of cameras that are a little turned and moved."""
    generator = torch.Generator().manual_seed(seed)

    def normal(*shape):
        return torch.randn(*shape, generator=generator, dtype=torch.float64)

    depths = torch.linspace(2, 5, count, dtype=torch.float64)[:, None]
    means = torch.cat((0.3 * normal(count, 2) * depths, depths), -1)
    gaussians = Gaussians(
        means=means,
        quats=normal(count, 4),
        scales=0.12 * depths * (0.4 * normal(count, 3)).exp(),
        opacities=torch.rand(count, generator=generator, dtype=torch.float64) * 0.4 + 0.3,
        sh=0.3 * normal(count, (degree + 1) ** 2, 3),
    )
    rotations = torch.linalg.matrix_exp(0.05 * (lambda m: m - m.mT)(normal(views, 3, 3)))
    cam_to_world = torch.eye(4, dtype=torch.float64).repeat(views, 1, 1)
    cam_to_world[:, :3, :3] = rotations
    cam_to_world[:, :3, 3] = 0.1 * normal(views, 3)
    intrinsics = torch.tensor(
        [[width, 0, 0.45 * width], [0, 0.9 * width, 0.55 * height], [0, 0, 1]], dtype=torch.float64
    ).repeat(views, 1, 1)
    cameras = Cameras(intrinsics, cam_to_world, height, width)
    return gaussians.to(dtype), cameras.to(dtype)


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
                alpha = min(0.99, float(opacity * torch.exp(-0.5 * d @ conic @ d)))
                if alpha < 1 / 255:
                    continue
                if left * (1 - alpha) < 1e-4:
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
def test_matches_a_loop_over_pixels(opaque, height, width):
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


@pytest.mark.parametrize("name", INPUTS)
def test_gradients_equal_finite_differences(name):
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

    def outputs(tensor):
        now = {**tensors, name: tensor}
        out = render(
            Gaussians(*(now[field] for field in INPUTS[:5])),
            Cameras(now["intrinsics"], now["cam_to_world"], cameras.height, cameras.width),
            now["background"],
        )
        return tuple(
            (image * weight).sum((-1, -2))
            for image, weight in zip((out.image, out.alpha, out.depth), weights, strict=True)
        )

    weights = torch.randn(3, 5, 6, dtype=torch.float64)
    assert torch.autograd.gradcheck(outputs, tensors[name].clone().requires_grad_(), atol=1e-7)


def test_one_gaussian_at_its_centre():
    gaussians = Gaussians(
        means=torch.tensor([[0.5, 0.5, 2.0]]),  # projects to the centre of pixel (5, 5)
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


def test_batches_and_views_equal_single_renders():
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


def test_order_of_gaussians_does_not_matter():
    gaussians, cameras = make_scene(count=40)
    order = torch.randperm(40)
    shuffled = render(gaussians.map(lambda t: t[order]), cameras)
    torch.testing.assert_close(shuffled.image, render(gaussians, cameras).image)


@pytest.mark.parametrize("keep", [0, 12])
def test_nothing_to_see_gives_the_background(keep):
    gaussians, cameras = make_scene(views=2)
    gaussians = gaussians.map(lambda t: t[:keep])
    gaussians.means[:, 2] -= 20
    background = torch.tensor([0.1, 0.2, 0.3], dtype=torch.float64, requires_grad=True)
    gaussians.map(lambda t: t.requires_grad_())
    out = render(gaussians, cameras, background)
    assert (out.image == background[:, None, None]).all()
    assert (out.alpha == 0).all() and (out.depth == 0).all()
    assert out.stats["visible"] == 0 and out.stats["intersections"] == 0
    out.image.sum().backward()
    assert all((getattr(gaussians, name).grad == 0).all() for name in INPUTS[:5])
    assert (background.grad == 2 * 13 * 17).all()


def test_unusable_gaussians_are_culled_and_get_no_gradient():
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
    for name in INPUTS[:5]:
        grad = getattr(gaussians, name).grad
        assert (grad[:8] == 0).all() and grad[8:].isfinite().all() and (grad[8:] != 0).any()


def test_far_from_the_origin_in_float32():
    gaussians, cameras = make_scene(count=40, views=2, dtype=torch.float32)
    # On a grid that float32 holds at 1e5 too, so that the two scenes are the same.
    gaussians.means.mul_(64).round_().div_(64)
    cameras.cam_to_world[..., :3, 3].mul_(64).round_().div_(64)
    near = render(gaussians, cameras)
    gaussians.means.add_(131072.0)
    cameras.cam_to_world[..., :3, 3].add_(131072.0)
    torch.testing.assert_close(render(gaussians, cameras).image, near.image, rtol=0, atol=1e-6)


@pytest.mark.parametrize("dtype", [torch.float16, torch.bfloat16])
def test_half_precision_is_computed_in_float32(dtype):
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


def test_any_tiles_and_groups_give_the_same_image(monkeypatch):
    gaussians, cameras = make_scene(count=60, views=2, height=19)

    def run():
        means = gaussians.means.clone().requires_grad_()
        out = render(replace(gaussians, means=means), cameras)
        return out.image, *torch.autograd.grad(out.image.square().sum(), means)

    before = run()
    monkeypatch.setattr(reference, "GROUP_ELEMENTS", 1)
    torch.testing.assert_close(run(), before)
    monkeypatch.setattr(reference, "TILE_SIZE", 7)
    torch.testing.assert_close(run(), before)


def test_equal_depths_are_drawn_in_the_order_of_their_index():
    gaussians, cameras = make_scene(count=2)
    gaussians = gaussians.map(lambda t: t[:1].repeat(2, *(1,) * (t.ndim - 1)))
    gaussians.sh[1] = 1
    alone = render(gaussians.map(lambda t: t[:1]), cameras)
    both = render(gaussians, cameras)
    behind = render(gaussians.map(lambda t: t[1:]), cameras)
    expected = alone.image + (1 - alone.alpha) * behind.image
    torch.testing.assert_close(both.image, expected)


def test_a_needle_has_the_alpha_of_float64():
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


def test_a_huge_gaussian_covers_the_screen():
    gaussians, cameras = make_scene(count=1, dtype=torch.float32)
    gaussians.scales.fill_(1e10)
    gaussians.map(lambda t: t.requires_grad_())
    out = render(gaussians, cameras)
    torch.testing.assert_close(out.alpha, gaussians.opacities.detach().expand(1, 13, 17))
    out.image.sum().backward()
    assert all(getattr(gaussians, name).grad.isfinite().all() for name in INPUTS[:5])


def test_the_unit_of_length_does_not_matter():
    gaussians, cameras = make_scene(dtype=torch.float32)
    before = render(gaussians, cameras)
    cameras.cam_to_world[:, :3, 3] *= 8
    after = render(gaussians.scale_by(8.0), cameras)
    torch.testing.assert_close(after.image, before.image, rtol=0, atol=1e-6)
    torch.testing.assert_close(after.depth, 8 * before.depth)


def test_two_runs_give_the_same_bits():
    gaussians, cameras = make_scene(
        count=3000, views=4, height=48, width=48, degree=3, dtype=torch.float32
    )

    def run():
        leaves = [gaussians.means, gaussians.scales, gaussians.sh, gaussians.opacities]
        leaves = [t.requires_grad_() for t in (*leaves, cameras.cam_to_world)]
        out = render(gaussians, cameras)
        return (out.image, *torch.autograd.grad(out.image.square().sum(), leaves))

    for first, second in zip(run(), run(), strict=True):
        assert torch.equal(first, second)


def test_depth_is_optional():
    gaussians, cameras = make_scene()
    out = render(gaussians, cameras, depth=False)
    assert out.depth is None
    torch.testing.assert_close(out.image, render(gaussians, cameras).image)


def test_errors_say_what_to_do():
    gaussians, cameras = make_scene()
    with pytest.raises(InputError, match=r"'fast'.*auto, reference"):
        render(gaussians, cameras, backend="fast")
    with pytest.raises(InputError, match=r"\(2,\).*\(\)"):
        render(gaussians.map(lambda t: torch.stack((t, t))), cameras)
    with pytest.raises(InputError, match=r"\(1,\).*\(3,\) or \(1, 3\)"):
        render(gaussians, cameras, torch.ones(1, dtype=torch.float64))
