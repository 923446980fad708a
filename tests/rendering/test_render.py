"""The reference renderer against a loop over pixels and against results computed by hand."""

from dataclasses import replace

import pytest
import torch
from textbook import textbook_alphas

from asysplat.errors import InputError
from asysplat.geometry.spherical_harmonics import SH_C0
from asysplat.rendering import INRIA, blending_weights, render
from asysplat.rendering.reference import rasterize


def pixel_loop(gaussians, cameras, background):
    """Composite one view of degree 1 pixel by pixel; return image, alpha and depth."""
    count = gaussians.num_gaussians
    views = cameras.map(lambda t: t.expand(count, *t.shape))
    splats, z = textbook_alphas(gaussians.map(lambda t: t[:, None]), views)
    offsets = torch.nn.functional.normalize(gaussians.means - cameras.centers, dim=-1)
    linear = 0.4886025119029199 * offsets[:, [1, 2, 0]] * torch.tensor([-1, 1, -1])
    basis = torch.cat((torch.full((count, 1), SH_C0, dtype=torch.float64), linear), -1)
    colors = (0.5 + (basis[..., None] * gaussians.sh).sum(1)).clamp(min=0)
    order = z.argsort().tolist()

    height, width = cameras.height, cameras.width
    image, alphas, depths = torch.zeros(5, height, width).double().split((3, 1, 1))
    alphas, depths = alphas[0], depths[0]
    for row in range(height):
        for column in range(width):
            left, depth = 1.0, 0.0
            for index in order:
                alpha = float(splats[index, row, column])
                if left * (1 - alpha) < INRIA.transmittance_min:
                    break
                image[:, row, column] += left * alpha * colors[index]
                depth += left * alpha * float(z[index])
                left *= 1 - alpha
            image[:, row, column] += left * background
            alphas[row, column] = 1 - left
            depths[row, column] = depth / (1 - left) if left < 1 else 0
    return image, alphas, depths


@pytest.mark.parametrize("height, width", [(1, 1), (1, 40), (13, 17)])
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


def test_a_render_in_a_cuda_graph_is_an_error(make_scene, monkeypatch):
    monkeypatch.setattr(torch.Tensor, "is_cuda", True)
    monkeypatch.setattr(torch.cuda, "is_current_stream_capturing", lambda: True)
    gaussians, cameras = make_scene(dtype=torch.float32)
    gaussians.means.fill_(torch.nan)  # validation would wait for the GPU
    with pytest.raises(InputError, match=r"waits for the GPU.* call it outside torch.cuda.graph.$"):
        render(gaussians, cameras, validate=True)


def test_blending_weights_are_what_a_white_gaussian_adds_to_black_ones(make_scene):
    gaussians, cameras = make_scene(count=60, views=3, degree=2, dtype=torch.float32)
    weights = blending_weights(gaussians, cameras)
    sh = torch.full((60, 1, 3), -0.5 / SH_C0)
    for index in (0, 17, 59):
        sh[index] *= -1
        expected = render(replace(gaussians, sh=sh), cameras).image[:, 0].sum()
        torch.testing.assert_close(weights[index], expected, rtol=1e-4, atol=1e-4)
        sh[index] *= -1
