"""The viewer's cameras and layers, without a page."""

import math
from dataclasses import replace
from functools import partial
from types import SimpleNamespace

import numpy as np
import pytest
import torch

from asysplat import Cameras, Gaussians, render
from asysplat.export.viewer import draw_layer
from asysplat.export.viewer_cameras import (
    clicked_camera,
    client_camera,
    field_of_view,
    mean_up,
    quaternion,
)


def test_up_is_the_mean_of_the_cameras(make_scene):
    _, cameras = make_scene(views=5, dtype=torch.float32)
    assert mean_up(cameras)[1] < -0.99
    assert mean_up(cameras).norm() == pytest.approx(1)
    poses = cameras.cam_to_world.clone()
    poses[1] = poses[0] @ torch.diag(torch.tensor([-1.0, -1, 1, 1]))
    opposed = replace(cameras, cam_to_world=poses).select([0, 1])
    torch.testing.assert_close(mean_up(opposed), -poses[0, :3, 1])


def page_of(cameras, view):
    """viser's camera of a page at an input camera."""
    return SimpleNamespace(
        wxyz=quaternion(cameras, view),
        position=cameras.centers[view].numpy(),
        fov=field_of_view(cameras, view)[0],
        image_height=cameras.height,
        image_width=cameras.width,
    )


def test_a_page_at_an_input_camera_has_its_view(make_scene):
    _, cameras = make_scene(views=3, height=60, width=80, dtype=torch.float32)
    focal = torch.tensor([[70.0, 0, 40], [0, 70, 30], [0, 0, 1]])
    cameras = replace(cameras, intrinsics=focal.repeat(3, 1, 1))
    for view in range(3):
        camera, in_full = client_camera(page_of(cameras, view), 60 * 80)
        assert in_full and (camera.height, camera.width) == (60, 80)
        torch.testing.assert_close(camera.intrinsics[0], focal)
        torch.testing.assert_close(camera.cam_to_world[0], cameras.cam_to_world[view])
    assert field_of_view(cameras, 0)[1] == pytest.approx(80 / 60)
    # Fewer pixels keep the field of view.
    cameras = cameras.resized(600, 800)
    camera, in_full = client_camera(page_of(cameras, 0), 30_000)
    assert not in_full and (camera.height, camera.width) == (150, 200)
    expected = 2 * math.atan(75 / camera.intrinsics[0, 1, 1].item())
    assert expected == pytest.approx(field_of_view(cameras, 0)[0])


def test_a_click_hits_the_first_visible_image(make_scene):
    _, cameras = make_scene(views=3, height=60, width=80, dtype=torch.float32)
    poses = torch.eye(4).repeat(3, 1, 1)
    poses[:, 2, 3] = torch.tensor([0.0, 1, 2])  # one behind the other, looking ahead
    cameras = replace(cameras, cam_to_world=poses)
    start, ahead = torch.zeros(3), torch.tensor([0.01, 0.01, 1])
    assert clicked_camera(cameras, 0.1, start, 0.01 * ahead) == 0
    assert clicked_camera(cameras, 0.1, start, 0.15 * ahead) == 1
    assert clicked_camera(cameras, 0.1, start, 1.15 * ahead) == 2
    assert clicked_camera(cameras, 0.1, torch.tensor([0.0, 0, 5]), -0.01 * ahead) == 2
    assert clicked_camera(cameras, 0.1, start, -0.01 * ahead) is None
    assert clicked_camera(cameras, 0.1, torch.tensor([0.2, 0, 0]), 0.01 * ahead) is None
    # 0.1 * 80 / 80 wide: 0.05 to each side.
    for x, met in ((0.049, 0), (0.051, None)):
        ray = torch.tensor([0, 0, 0.01])
        assert clicked_camera(cameras, 0.1, torch.tensor([x, 0, 0]), ray) == met


@pytest.fixture(scope="module")
def scene(make_scene):
    return make_scene(count=60, height=24, width=32, dtype=torch.float32)


def bytes_of(image):
    return (255 * image.clamp(0, 1)).round().byte().numpy()


def test_color_and_alpha_are_those_of_the_renderer(scene):
    background = (0.0, 0.0, 1.0)
    rendering = render(*scene, torch.tensor(background))
    color, alpha = (
        draw_layer(*scene, layer, background=background) for layer in ("color", "alpha")
    )
    np.testing.assert_array_equal(color, bytes_of(rendering.image[0]).transpose(1, 2, 0))
    for channel in range(3):
        np.testing.assert_array_equal(alpha[..., channel], bytes_of(rendering.alpha[0]))
    assert color.std() > 20 and alpha.std() > 20


def test_drawn_depth_is_bright_where_near_and_of_one_color_where_empty(scene):
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


def test_settings_of_the_panel_change_what_is_drawn(scene):
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
    small = partial(draw_layer, gaussians, camera, layer="alpha", size=0.05)
    assert small(antialiased=True).mean() < 0.8 * small().mean()
