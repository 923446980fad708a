"""Layers of the viewer show what `render` returns."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from asysplat import Cameras, Gaussians, render
from asysplat.export.viewer import draw_layer


@pytest.fixture(scope="module")
def scene(make_scene):
    return make_scene(count=60, height=24, width=32, dtype=torch.float32)


def bytes_of(image):
    return (255 * image.clamp(0, 1)).round().byte().numpy()


def test_color_and_alpha_are_those_of_the_renderer(scene):
    rendering = render(*scene)
    color, alpha = draw_layer(*scene), draw_layer(*scene, layer="alpha")
    np.testing.assert_array_equal(color, bytes_of(rendering.image[0]).transpose(1, 2, 0))
    for channel in range(3):
        np.testing.assert_array_equal(alpha[..., channel], bytes_of(rendering.alpha[0]))
    assert color.std() > 20 and alpha.std() > 20


def test_near_is_bright_and_an_empty_image_of_one_color(scene):
    focal = torch.tensor([[[20.0, 0, 16], [0, 20, 8], [0, 0, 1]]])
    gaussians = Gaussians(
        means=torch.tensor([[-1.0, 0, 2], [2, 0, 4]]),
        quats=torch.tensor([[1.0, 0, 0, 0]] * 2),
        scales=torch.full((2, 3), 0.2),
        opacities=torch.full((2,), 0.99),
        sh=torch.zeros(2, 1, 3),
    )
    image = draw_layer(gaussians, Cameras(focal, torch.eye(4)[None], 16, 32), layer="depth")
    assert image.shape == (16, 32, 3) and image.dtype == np.uint8 and np.ptp(image) > 50
    near, far, nothing = (image[8, column].astype(int).sum() for column in (6, 26, 16))
    assert near > far > nothing
    gaussians, camera = scene
    behind = replace(gaussians, means=gaussians.means * torch.tensor([1, 1, -1.0]))
    assert np.ptp(draw_layer(behind, camera, layer="depth"), axis=(0, 1)).max() == 0


def test_settings_of_the_panel(scene):
    gaussians, camera = scene
    least = gaussians.opacities.median().item()
    kept = gaussians.keep(gaussians.opacities >= least)
    assert 0 < kept.num_gaussians < gaussians.num_gaussians
    for settings, expected in (
        ({"min_opacity": least}, kept),
        ({"sh_degree": 0}, replace(gaussians, sh=gaussians.sh[:, :1])),
        ({"size": 0.5}, replace(gaussians, scales=gaussians.scales / 2)),
    ):
        drawn = draw_layer(gaussians, camera, **settings)
        np.testing.assert_array_equal(drawn, draw_layer(expected, camera))
        assert (drawn != draw_layer(gaussians, camera)).any()
    alphas = [draw_layer(gaussians, camera, layer="alpha", size=size).mean() for size in (0.5, 1.0)]
    assert alphas[0] < 0.8 * alphas[1]
