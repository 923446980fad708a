"""Layers show what `render` returns; the error is unknown where no image was taken."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from asysplat import Cameras, Gaussians, Views, render
from asysplat.export.layers import LAYERS, draw_layer, image_at, thumbnail


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


@pytest.mark.parametrize("layer", LAYERS)
def test_every_layer_is_an_rgb_image(scene, layer):
    image = draw_layer(*scene, layer=layer, target=torch.rand(3, 24, 32))
    assert image.shape == (24, 32, 3) and image.dtype == np.uint8
    assert np.ptp(image) > 50


def test_near_is_bright():
    camera = Cameras(
        torch.tensor([[[20.0, 0, 16], [0, 20, 8], [0, 0, 1]]]), torch.eye(4)[None], 16, 32
    )
    gaussians = Gaussians(
        means=torch.tensor([[-1.0, 0, 2], [2, 0, 4]]),
        quats=torch.tensor([[1.0, 0, 0, 0]] * 2),
        scales=torch.full((2, 3), 0.2),
        opacities=torch.full((2,), 0.99),
        sh=torch.zeros(2, 1, 3),
    )
    image = draw_layer(gaussians, camera, layer="depth").astype(int)
    near, far, nothing = (image[8, column].sum() for column in (6, 26, 16))
    assert near > far > nothing


def test_the_depth_of_an_empty_image(scene):
    gaussians, camera = scene
    behind = replace(gaussians, means=gaussians.means * torch.tensor([1, 1, -1.0]))
    assert np.ptp(draw_layer(behind, camera, layer="depth"), axis=(0, 1)).max() == 0


def test_minimum_opacity(scene):
    gaussians, camera = scene
    least = gaussians.opacities.median().item()
    kept = gaussians.keep(gaussians.opacities >= least)
    hidden = draw_layer(gaussians, camera, min_opacity=least)
    np.testing.assert_array_equal(hidden, draw_layer(kept, camera))
    assert 0 < kept.num_gaussians < gaussians.num_gaussians


def test_sh_degree(scene):
    gaussians, camera = scene
    constant = replace(gaussians, sh=gaussians.sh[:, :1])
    drawn = draw_layer(gaussians, camera, sh_degree=0)
    np.testing.assert_array_equal(drawn, draw_layer(constant, camera))
    assert (drawn != draw_layer(gaussians, camera, sh_degree=1)).any()


def test_size(scene):
    gaussians, camera = scene
    half = draw_layer(gaussians, camera, layer="alpha", size=0.5)
    smaller = replace(gaussians, scales=gaussians.scales / 2)
    np.testing.assert_array_equal(half, draw_layer(smaller, camera, layer="alpha"))
    assert half.mean() < 0.8 * draw_layer(gaussians, camera, layer="alpha").mean()


def test_error_is_black_where_correct_or_unknown(scene):
    rendered = render(*scene).image[0].clamp(0, 1)
    black = draw_layer(*scene, layer="error", target=rendered)
    assert np.ptp(black, axis=(0, 1)).max() == 0
    wrong = rendered.clone()
    wrong[:, :12] = (wrong[:, :12] + 0.5) % 1
    wrong[:, :, :16] = torch.nan
    error = draw_layer(*scene, layer="error", target=wrong)
    assert (error[:12, 16:] != black[:12, 16:]).any(-1).all()
    np.testing.assert_array_equal(error[:, :16], black[:, :16])
    np.testing.assert_array_equal(error[12:], black[12:])


def test_error_without_a_target_is_the_color(scene):
    np.testing.assert_array_equal(draw_layer(*scene, layer="error"), draw_layer(*scene))


def sky(cameras):
    """Images of something endlessly far away: its color is that of the direction."""
    return 0.5 + 0.5 * cameras.rays()[1].movedim(-1, -3)


@pytest.fixture
def views(make_scene):
    _, cameras = make_scene(views=3, height=48, width=64, dtype=torch.float32)
    return Views(cameras, sky(cameras))


def test_image_at_its_own_camera(views):
    for view in range(3):
        seen = image_at(views, views.cameras.select([view]), 1e-3)
        torch.testing.assert_close(seen, views.images[view], atol=1e-4, rtol=0)


def test_image_at_another_camera_at_the_same_position(views):
    """Of other size, field of view and rotation."""
    own = views.cameras.select([1])
    turn = torch.eye(4)
    turn[:3, :3] = torch.linalg.matrix_exp(
        torch.tensor([[0, -0.1, 0.2], [0.1, 0, -0.1], [-0.2, 0.1, 0]])
    )
    intrinsics = torch.tensor([[[30.0, 0, 20], [0, 30, 15], [0, 0, 1]]])
    camera = Cameras(intrinsics, own.cam_to_world @ turn, 30, 40)
    seen = image_at(views, camera, 1e-3)
    known = seen.isfinite().all(0)
    assert 0.3 < known.float().mean() < 1
    torch.testing.assert_close(seen[:, known], sky(camera)[0][:, known], atol=0.01, rtol=0)


def test_no_image_behind_a_camera(views):
    around = torch.diag(torch.tensor([-1.0, 1, -1, 1]))
    camera = views.cameras.select([0])
    camera = replace(camera, cam_to_world=camera.cam_to_world @ around)
    assert image_at(views, camera, 1e-3).isnan().all()


def test_masked_pixels_are_unknown(views):
    masks = torch.ones(3, 48, 64, dtype=torch.bool)
    masks[:, 10:20] = False
    masked = replace(views, masks=masks)
    seen = image_at(masked, views.cameras.select([2]), 1e-3)
    torch.testing.assert_close(seen.isfinite().all(0), masks[2])


def test_no_image_at_other_positions(views):
    camera = views.cameras.select([0])
    poses = camera.cam_to_world.clone()
    poses[:, 0, 3] += 0.01
    assert image_at(views, replace(camera, cam_to_world=poses), 1e-3) is None


def test_the_image_with_the_nearest_direction(views):
    poses = views.cameras.cam_to_world[:1].repeat(2, 1, 1)
    poses[0] = poses[0] @ torch.diag(torch.tensor([-1.0, 1, -1, 1]))
    cameras = replace(views.cameras.select([0, 0]), cam_to_world=poses)
    views = Views(cameras, sky(cameras))
    for view in range(2):
        seen = image_at(views, cameras.select([view]), 1e-3)
        torch.testing.assert_close(seen, views.images[view], atol=1e-4, rtol=0)


def test_thumbnails_are_small_and_as_bright():
    image = torch.rand(3, 150, 300)
    small = thumbnail(image)
    assert small.shape == (48, 96, 3)
    np.testing.assert_allclose(small.mean((0, 1)) / 255, image.mean((1, 2)), atol=0.01)
    np.testing.assert_array_equal(
        thumbnail(image[:, :20, :30]), bytes_of(image[:, :20, :30]).transpose(1, 2, 0)
    )
